#!/usr/bin/env bash
# The whole pipeline on Slurm, submitted in one go: arrays of shards, merges, training on several nodes, all chained.
#
#   examples/cluster/slurm_pipeline.sh DEM IMAGES_CSV FOLDER
#
# Settings (environment): LUNARGR=lunargr  SHARDS=32  IMAGE_SHARDS=SHARDS  NODES=2  GPUS=4  GSD=5  CROP=128  COUNT=80000
# MODEL=M2  EPOCHS=20  SEED=0, and those of slurm_array.sh. What exists is not made again: after a failure, mend its cause
# and run the same line once more. DRY_RUN=1 prints what would be submitted.
set -euo pipefail

if [ $# -lt 3 ]; then
    sed -n '2,9s/^# \{0,1\}//p' "$0" >&2
    exit 2
fi
dem=$1 images=$2 folder=$3
: "${LUNARGR:=lunargr}" "${SHARDS:=32}" "${NODES:=2}" "${GPUS:=4}" "${GSD:=5}" "${CROP:=128}" "${COUNT:=80000}"
: "${IMAGE_SHARDS:=$SHARDS}" "${MODEL:=M2}" "${EPOCHS:=20}" "${SEED:=0}" "${SBATCH_OPTIONS:=}"
export LUNARGR
here=$(cd "$(dirname "$0")" && pwd)
mkdir -p "$folder"
last=${AFTER:-} # the job that the next one has to wait for

# wide OUTPUT SHARDS STAGE ARGUMENTS...
wide() {
    [ -e "$1" ] && return
    last=$(AFTER=$last "$here/slurm_array.sh" "$2" "$1" "${@:3}")
}

# one OUTPUT SBATCH_WORDS...: a single job
one() {
    local output=$1
    shift
    [ -e "$output" ] && return
    local words=(sbatch --parsable)
    [ -z "$SBATCH_OPTIONS" ] || { read -r -a extra <<<"$SBATCH_OPTIONS" && words+=("${extra[@]}"); }
    [ -z "$last" ] || words+=(--dependency="afterok:$last")
    words+=("$@")
    if [ -n "${DRY_RUN:-}" ]; then
        printf '%q ' "${words[@]}" >&2
        echo >&2
        last=12345
    else
        last=$("${words[@]}")
    fi
}

# The DEM's rows first, then each image on the grid that they give.
wide "$folder/grid.h5" "$SHARDS" ingest "$dem" --gsd "$GSD" --crop "$CROP"
wide "$folder/scene.h5" "$IMAGE_SHARDS" ingest "$folder/grid.h5" --images "$images" --crop "$CROP"
wide "$folder/crops.h5" 4 sample "$folder/scene.h5" --count "$COUNT" --seed "$SEED"
wide "$folder/pairs.h5" "$SHARDS" project "$folder/crops.h5"
one "$folder/checkpoint.h5" --nodes="$NODES" --gpus-per-node="$GPUS" "$here/slurm_train.sh" \
    "$folder/pairs.h5" "$folder/checkpoint.h5" --model "$MODEL" --epochs "$EPOCHS" --seed "$SEED"
trained=$last
wide "$folder/svbrdf.h5" "$SHARDS" infer "$folder/scene.h5" "$folder/checkpoint.h5"
last=$trained
one "$folder/evaluation.h5" --job-name=lunargr-evaluate --cpus-per-task=4 --mem=8G --time=04:00:00 --wrap \
    "$LUNARGR evaluate $(printf '%q ' "$folder/pairs.h5" "$folder/checkpoint.h5")--resume --output $(printf %q "$folder/evaluation.h5")"
