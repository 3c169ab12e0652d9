"""Presets: named sets of configuration keys for ``--preset``.

- ``paper``: hyper-parameters of R5DGS and of the methods that it builds on (TRACE, 3DGS, Gaussian Grouping), for a GPU:
  40000 steps and networks of width 256. It differs from them in five points: the networks' heads start at zero; the sky
  is learned; Adam has its usual epsilon for the networks; the learning rates of the centres decay over the whole run
  (3DGS: over 30000 steps); and coordinates are normalised, so that the rates are those for scenes of a few units.
- ``cpu``: the same method with defaults made for CPUs.
- ``fast``: a short run for a first impression of a data set.
"""

from __future__ import annotations

from typing import Any

PRESETS: dict[str, dict[str, Any]] = {
    "fast": {"train.iterations": 2000, "identity.iterations": 200},
    "cpu": {"train.representation": "field"},
    "paper": {
        "train.representation": "field",
        "train.iterations": 40000,
        "train.sh_degree": 3,
        "train.sh_every": 1000,
        "train.shading": False,
        "train.shadows": False,
        "train.checkpoint_every": 2000,
        "init.placement": "random",
        "init.background_points": 100000,
        "init.opacity": 0.1,
        # 3DGS rates as used by TRACE; the centres' fall from 1.6e-4 to 1.6e-6, times a spatial scale of 5.
        "rates.means": 8e-4,
        "rates.log_scales": 5e-3,
        "rates.sh": 2.5e-3,
        "rates.sh_rest": 1.25e-4,
        "rates.opacity_logits": 0.05,
        "rates.quats": 1e-3,
        "rates.field": 8e-4,
        "rates.trd": 8e-4,
        "rates.decay": 0.01,
        "rates.decay_networks": 0.002,
        "rates.decay_floor_appearance": 1.0,
        "rates.decay_from": 0.0,
        "losses.rigid": 0.5,
        "losses.rigid_form": "squared",
        "losses.rigid_start": 0.25,
        "curriculum.start": "first",
        "curriculum.first": 3000,
        "curriculum.grow": 7000,
        "curriculum.stages": 8,
        "curriculum.newest": 0.0,
        "densify.strategy": "default",
        "densify.max_gaussians": 300000,
        "densify_default.stop": 15000 / 40000,
        "densify_default.prune_opacity": 0.01,
        "field.size": "complex",
        "field.step": 1 / 30,
        "field.warm_up": 3000,
        "field.trd_share": 1.0,
        "field.movers": "all",
        "field.place_steps": 0,
        "field.trd_steps": 0,
        "field.twist": 0.0,
        "field.stiffness": 0.0,
        "identity.training": "joint",
        "identity.rate": 2.5e-3,
        "identity.classifier_rate": 5e-4,
        "identity.weight": 1.0,
        "identity.spatial": 2.0,
        "identity.majority": 0.5,
        "identity.regularise_every": 2,
        "identity.neighbours": 5,
        "identity.samples": 1000,
    },
}
