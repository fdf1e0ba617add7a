#!/usr/bin/env bash
# The whole pipeline on Slurm, submitted in one go: arrays of shards, merges, training on several nodes, all chained.
#
#   examples/cluster/slurm_pipeline.sh DEM IMAGES_CSV FOLDER
#
# Settings (environment): SHARDS=32  IMAGE_SHARDS=SHARDS  GSD=5  CROP=128  COUNT=80000  MODEL=hapke  EPOCHS=20  SEED=0
#   REGISTER=  constant, affine or field: take off how far images lie from their renderings; nothing without
#   NODES=1  GPUS=1  of each node, for training; GPUS=0 trains on CPUs
#   TRAIN_OPTIONS="--cpus-per-task=8 --mem=32G --time=12:00:00 -p gpu"  in place of what slurm_train.sh asks for
# and those of slurm_array.sh, which hold for all other jobs. Every job is shown to Slurm before the first is submitted;
# a second chain beside one in the queue is refused. What exists is not made again: after a failure, mend its cause and
# run the same line again. DRY_RUN=1 prints what would be submitted.
set -euo pipefail

if [ $# -lt 3 ]; then
    sed -n '2,12s/^# \{0,1\}//p' "$0" >&2
    exit 2
fi
dem=$1 images=$2 folder=$3
: "${SHARDS:=32}" "${NODES:=1}" "${GPUS:=1}" "${GSD:=5}" "${CROP:=128}" "${COUNT:=80000}" "${IMAGE_SHARDS:=$SHARDS}"
: "${MODEL:=hapke}" "${EPOCHS:=20}" "${SEED:=0}" "${REGISTER:=}" "${TRAIN_OPTIONS:=}"
here=$(cd "$(dirname "$0")" && pwd)
# shellcheck source-path=SCRIPTDIR source=slurm_jobs.bash
. "$here/slurm_jobs.bash"
export LUNARGR
mkdir -p "$folder"

scene=$folder/scene.h5 pairs=$folder/pairs.h5 checkpoint=$folder/checkpoint.h5 map=$folder/svbrdf.h5
register=() training=(--nodes="$NODES")
[ -z "$REGISTER" ] || register=(--register "$REGISTER")
[ "$GPUS" = 0 ] || training+=(--gpus-per-node="$GPUS")
read -r -a options <<<"$TRAIN_OPTIONS"
training+=(${options[@]+"${options[@]}"})

pipeline() {
    # The DEM's rows first, then each image on the grid that they give.
    wide "$folder/grid.h5" "$SHARDS" ingest "$dem" --gsd "$GSD" --crop "$CROP"
    wide "$scene" "$IMAGE_SHARDS" ingest "$folder/grid.h5" --images "$images" --crop "$CROP"
    wide "$folder/crops.h5" 4 sample "$scene" --count "$COUNT" --seed "$SEED"
    wide "$pairs" "$SHARDS" project "$folder/crops.h5" ${register[@]+"${register[@]}"}
    [ -e "$checkpoint" ] || submit "$checkpoint" "${training[@]}" "$here/slurm_train.sh" \
        "$pairs" "$checkpoint" --model "$MODEL" --epochs "$EPOCHS" --seed "$SEED"
    local trained=$last
    one "$folder/evaluation.h5" evaluate "$pairs" "$checkpoint" --resume
    last=$trained
    wide "$map" "$SHARDS" infer "$scene" "$checkpoint"
    # The images are calibrated once, for all shards.
    one "$folder/calibration.json" albedo "$map" "$scene" ${register[@]+"${register[@]}"}
    wide "$folder/svbrdf_albedo.h5" "$SHARDS" albedo "$map" "$scene" ${register[@]+"${register[@]}"} \
        --calibration "$folder/calibration.json"
}
submit_all "$folder" pipeline
