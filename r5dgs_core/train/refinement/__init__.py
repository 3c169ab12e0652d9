"""Refinement of the cameras in training: poses, focal lengths, clocks and colours."""
