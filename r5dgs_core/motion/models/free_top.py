"""A body that flies along a parabola and tumbles without torque."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from .. import rotations, se3, torque_free_rotation
from .base import Curve, MotionKind, MotionModel, Rates, time_factors


class FreeTop(MotionKind):
    """d_f = v s1 + a s2; R_f is the rotation of a body that starts with spin w and tumbles without torque
    (`motion.torque_free_rotation`).

    It needs the body's inertia, so `model_selection` tries it separately.
    """

    label = "Tumble"
    tooltip = "Flies and spins freely, like a rigid body of its shape without contact"
    word = "tumble"
    fields = ("velocity", "acceleration", "angular_velocity")
    needs_inertia = True
    fits = {"free top": ("v", "a", "w")}
    fits_by_default = False

    def curve(self, model: MotionModel, tau: np.ndarray, most_steps: int | None) -> Curve:
        assert model.inertia is not None
        span = tau[..., None]
        once, twice = time_factors(model.frequency, span)
        slope = np.cos(model.frequency * span)  # derivative of s1; that of s2 is s1
        quats, spins = torque_free_rotation.rotations_and_spins(model.inertia, model.angular_velocity, tau.reshape(-1))
        quats, spins = quats.reshape(*tau.shape, 4), spins.reshape(*tau.shape, 3)
        v, a = model.velocity, model.acceleration
        return quats, v * once + a * twice, spins, v * slope + a * once

    def stacked(self, models: Sequence[MotionModel]) -> Callable[[float], se3.Pose]:
        rates = Rates.of(models)
        tops = torque_free_rotation.Tops(np.array([model.inertia for model in models]), rates.w)

        def poses(tau: float) -> se3.Pose:
            once, twice = rates.time_factors(np.array([[tau]]))
            return tops.turns(tau), rates.v * once + rates.a * twice

        return poses

    def fitted(
        self, rates: Rates, rotvec: np.ndarray, displacement: np.ndarray, tau: np.ndarray, inertia: np.ndarray | None
    ) -> se3.Pose:
        """The inertia rotates with the pose at time 0: R = exp(r) R_top(exp(-r) w)."""
        assert inertia is not None
        first, span = rotations.rotvecs_to_quats(rotvec), tau[:, None]
        starts = rotations.rotate(rotations.conjugate(first), rates.w)[..., 0, :]
        # Most parameter vectors of a Jacobian change the position alone.
        own, rows = np.unique(starts.reshape(-1, 3), axis=0, return_inverse=True)
        quats = torque_free_rotation.rotations_and_spins(inertia, own, tau)[0][rows.reshape(starts.shape[:-1])]
        return rotations.multiply(first, quats), displacement + rates.v * span + rates.a * (0.5 * span**2)

    def spins(self, model: MotionModel) -> bool:
        return bool(model.angular_velocity.any())


KIND = FreeTop()
