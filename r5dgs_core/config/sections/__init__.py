"""Sections of the configuration; the docstring of each describes its keys.

Lengths are in the normalised coordinates of training, in which the cameras are about 4 units from the point that they
look at (`train/normalization.py`). Numbers of steps are meant for runs of ``train.iterations`` = 6000, unless stated
otherwise.
"""
