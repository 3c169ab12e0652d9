#!/bin/bash
# Render frames of a .blend with the R5DGS engine, by the tasks of a Slurm array:
#
#     sbatch --array=0-9 render_array.sh FILE.blend DIR/###### FIRST LAST
#
# Each task renders its part of FIRST..LAST, which replaces the range and the step of the scene. Existing frames are
# left, so a task may be requeued, and the same line renders what is missing after failures. The environment variable
# BLENDER names the program, by default `blender`.
#SBATCH --job-name=r5dgs
#SBATCH --output=%x-%A-%a.log
#SBATCH --open-mode=append
#SBATCH --requeue
#SBATCH --cpus-per-task=2
set -u

if [ $# -ne 4 ] || ! [ "$3" -le "$4" ]; then
  echo "usage: sbatch --array=0-9 render_array.sh FILE.blend DIR/###### FIRST LAST (FIRST <= LAST)" >&2
  exit 2
fi
file=$1 output=$2 first=$3 last=$4
tasks=${SLURM_ARRAY_TASK_COUNT:-1}
task=$(((${SLURM_ARRAY_TASK_ID:-0} - ${SLURM_ARRAY_TASK_MIN:-0}) / ${SLURM_ARRAY_TASK_STEP:-1}))
each=$(((last - first + tasks) / tasks)) # rounded up
from=$((first + task * each))
to=$((from + each - 1 < last ? from + each - 1 : last))
if [ "$from" -gt "$to" ]; then
  echo "no frames are left for this task"
  exit 0
fi
for _ in 1 2 3; do
  "${BLENDER:-blender}" -b -y "$file" -o "$output" --command r5dgs_render --frames="$from..$to"
  status=$?
  case $status in
    134 | 137 | 139) echo "Blender was killed or crashed (status $status)" >&2 ;;
    *) exit $status ;;
  esac
done
exit $status
