#!/usr/bin/env bash
# One wide stage as a Slurm array: task I of N writes part I, a dependent job merges and removes the parts.
#
#   examples/cluster/slurm_array.sh N OUTPUT STAGE ARGUMENTS...
#   examples/cluster/slurm_array.sh 64 pairs.h5  project crops.h5
#   examples/cluster/slurm_array.sh 32 svbrdf.h5 infer scene.h5 checkpoint.h5
#
# Prints the id of the merging job, so that stages chain:
#   a=$(examples/cluster/slurm_array.sh 16 crops.h5 sample scene.h5 --count 80000 --seed 1)
#   b=$(AFTER=$a examples/cluster/slurm_array.sh 64 pairs.h5 project crops.h5)
#   sbatch --dependency=afterok:$b --gpus-per-node=1 examples/cluster/slurm_train.sh pairs.h5 checkpoint.h5
#
# Settings (environment): CPUS=4  MEM=8G  TIME=02:00:00  of a task; AFTER=JOBID  SBATCH_OPTIONS="-p short"
# LUNARGR=lunargr is the command: a path, or words that end in lunargr (apptainer exec lunargr.sif lunargr).
# A task whose part exists ends at once: after a failure, mend its cause and run the same line again. What waits for a
# failed task leaves the queue. DRY_RUN=1 prints what would be submitted, and needs no Slurm.
set -euo pipefail

if [ $# -lt 4 ]; then
    sed -n '2,17s/^# \{0,1\}//p' "$0" >&2
    exit 2
fi
# shellcheck source-path=SCRIPTDIR source=slurm_jobs.bash
. "$(dirname "$0")/slurm_jobs.bash"

if [ -e "$2" ]; then
    echo "$2: exists already; remove it to make it again" >&2
    exit 1
fi
submit_all "$2" wide "$2" "$1" "${@:3}"
echo "$last"
