"""Scenes of bodies that collide, simulated by Blender's rigid bodies, with parameters drawn by a seed."""
