"""Rigid motion: rotations, SE(3), motion models past t_max and key reduction; numpy alone."""
