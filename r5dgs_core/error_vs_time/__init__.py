"""``r5dgs report``: error against run time of integrators, poses, images and rasterizer settings."""
