#!/usr/bin/env bash
# One wide stage as a Slurm array: task I of N writes part I, a dependent job merges.
#
#   examples/cluster/slurm_array.sh N OUTPUT STAGE ARGUMENTS...
#   examples/cluster/slurm_array.sh 64 pairs.h5  project crops.h5
#   examples/cluster/slurm_array.sh 32 svbrdf.h5 infer dem.tif checkpoint.h5
#
# Prints the id of the merging job, so that stages chain:
#   a=$(examples/cluster/slurm_array.sh 16 crops.h5 sample scene.h5 --count 80000 --seed 1)
#   b=$(AFTER=$a examples/cluster/slurm_array.sh 64 pairs.h5 project crops.h5)
#   sbatch --dependency=afterok:$b --gpus=1 --wrap "lunargr train pairs.h5 --resume -o checkpoint.h5"
#
# Settings (environment): LUNARGR=lunargr  CPUS=4  MEM=8G  TIME=02:00:00  AFTER=JOBID  SBATCH_OPTIONS="-p short"
# A task whose part exists ends at once, so a resubmitted array makes only what is missing; a task killed by its time
# limit leaves no part. Without Slurm, DRY_RUN=1 prints what would be submitted.
set -euo pipefail

if [ $# -lt 4 ]; then
    sed -n '2,16s/^# \{0,1\}//p' "$0" >&2
    exit 2
fi
count=$1 output=$2
shift 2
: "${LUNARGR:=lunargr}" "${CPUS:=4}" "${MEM:=8G}" "${TIME:=02:00:00}" "${AFTER:=}" "${SBATCH_OPTIONS:=}"

stem=${output%.h5}
parts=()
for ((i = 1; i <= count; i++)); do parts+=("$stem.$i-of-$count.h5"); done
arguments=$(printf '%q ' "$@")

submit() {
    if [ -n "${DRY_RUN:-}" ]; then
        printf '%q ' sbatch "$@" >&2
        echo >&2
        echo 12345
    else
        sbatch --parsable "$@"
    fi
}

common=(--cpus-per-task="$CPUS" --mem="$MEM" --time="$TIME")
[ -z "$SBATCH_OPTIONS" ] || read -r -a extra <<<"$SBATCH_OPTIONS"
common+=(${extra[@]+"${extra[@]}"})
[ -z "$AFTER" ] || common+=(--dependency="afterok:$AFTER")

task="set -eu
export OMP_NUM_THREADS=$CPUS NUMBA_NUM_THREADS=$CPUS
part=$(printf %q "$stem").\$SLURM_ARRAY_TASK_ID-of-$count.h5
# put back into the queue: the lock was this very task's
[ \"\${SLURM_RESTART_COUNT:-0}\" = 0 ] || rm -f \"\$(dirname \"\$part\")/.\$(basename \"\$part\").lock\"
[ -e \"\$part\" ] || $LUNARGR $arguments --shard \$SLURM_ARRAY_TASK_ID/$count --output \"\$part\""
array=$(submit "${common[@]}" --job-name="lunargr-$1" --array="1-$count" --wrap "$task")

merge="$LUNARGR merge $(printf '%q ' "${parts[@]}")--output $(printf %q "$output") --overwrite"
submit --job-name="lunargr-merge-$1" --cpus-per-task=1 --mem="$MEM" --time="$TIME" ${extra[@]+"${extra[@]}"} \
    --dependency="afterok:$array" --wrap "$merge"
