"""Names and in-memory dtypes of the arrays of a scene file."""

from __future__ import annotations

import numpy as np

EMBEDDINGS = ("embeddings", "vocabulary_embeddings", "canonical_embeddings", "view_embeddings")
# In file order.
DTYPES: dict[str, type] = {
    "means": np.float32,
    "quats": np.float32,
    "log_scales": np.float32,
    "opacity_logits": np.float32,
    "sh": np.float32,
    "object_ids": np.int32,
    "motion_ids": np.int32,
    "track_times": np.float64,
    "track_poses": np.float64,
    "background_sh": np.float32,
    "identities": np.float16,
    "classifier_weight": np.float32,
    "classifier_bias": np.float32,
    "residual_rows": np.int32,
    "residual_offsets": np.float32,
    "residual_quats": np.float32,
    "residual_log_scales": np.float32,
    "dynamics": np.float32,
    "canonical_means": np.float32,
    "shading": np.float32,
    "shading_rest": np.float32,
    **dict.fromkeys(EMBEDDINGS, np.float32),
}
