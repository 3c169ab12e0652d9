"""File formats of other programs: Gaussians, scenes with motion, poses, bodies for simulators, cameras and images."""
