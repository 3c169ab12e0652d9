"""The `Scene` dataclass and its file: cameras, spherical harmonics, validation, `.r5dgs` reading and writing."""
