"""File formats of other programs: PLY, transforms.json, COLMAP text, PNG, OpenEXR and Cryptomatte."""
