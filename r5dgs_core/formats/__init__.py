"""File formats of other programs: PLY, glTF, OpenUSD, HTML, poses, transforms.json, COLMAP text, PNG, OpenEXR."""
