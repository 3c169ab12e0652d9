"""All tasks of the report, by name. A new one is a module with a `TASK`, an entry here and in `task_names.TASKS`."""

from __future__ import annotations

from . import candidate_count_task, image_task, integrator_task, pose_task, rasterizer_task, training_task

BY_NAME = {
    module.TASK.name: module.TASK
    for module in (integrator_task, pose_task, candidate_count_task, image_task, rasterizer_task, training_task)
}
