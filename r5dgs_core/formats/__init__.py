"""File formats of other programs: PLY, SPZ, SOG, glTF, 4dgs, OpenUSD, HTML, poses, camera files, PNG and OpenEXR."""
