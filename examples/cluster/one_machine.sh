#!/usr/bin/env bash
# The whole pipeline on one machine, its wide stages cut into shards that run side by side.
#
#   examples/cluster/one_machine.sh DEM IMAGES_CSV FOLDER [SHARDS]
#
# The same seed gives the same artefacts as a run in one piece, whatever SHARDS is. What exists is not made again:
# after a failure, run the same line once more. Settings, all optional (environment):
#   LUNARGR=lunargr  JOBS=2  GSD=5  CROP=128  COUNT=4000  MODEL=hapke  EPOCHS=20  SEED=0
set -euo pipefail

if [ $# -lt 3 ]; then
    sed -n '2,8s/^# \{0,1\}//p' "$0" >&2
    exit 2
fi
dem=$1 images=$2 folder=$3 shards=${4:-4}
: "${LUNARGR:=lunargr}" "${JOBS:=2}" "${GSD:=5}" "${CROP:=128}" "${COUNT:=4000}" "${MODEL:=hapke}" "${EPOCHS:=20}" "${SEED:=0}"
mkdir -p "$folder"

# Jobs run side by side: their threads together should not ask for more cores than there are.
cores=$(getconf _NPROCESSORS_ONLN)
threads=$((cores / JOBS > 0 ? cores / JOBS : 1))

# fan_out NAME ARGUMENTS...: `lunargr ARGUMENTS --shard I/N` for every I, JOBS at a time, merged to FOLDER/NAME.h5
fan_out() {
    local name=$1 i part
    local parts=()
    shift
    for ((i = 1; i <= shards; i++)); do
        part="$folder/$name.$i-of-$shards.h5"
        parts+=("$part")
        if [ -e "$folder/$name.h5" ] || [ -e "$part" ]; then continue; fi
        while (($(jobs -rp | wc -l) >= JOBS)); do wait -n || true; done
        echo "$name $i/$shards" >&2
        OMP_NUM_THREADS=$threads NUMBA_NUM_THREADS=$threads \
            "$LUNARGR" "$@" --shard "$i/$shards" --output "$part" --quiet &
    done
    wait
    [ -e "$folder/$name.h5" ] && return
    for part in "${parts[@]}"; do # parts are whole or absent
        [ -e "$part" ] || { echo "$part: its shard failed; mend the cause and run the same line again" >&2; exit 1; }
    done
    "$LUNARGR" merge "${parts[@]}" --output "$folder/$name.h5"
    rm "${parts[@]}"
}

[ -e "$folder/scene.h5" ] ||
    "$LUNARGR" ingest "$dem" --images "$images" --gsd "$GSD" --crop "$CROP" --output "$folder/scene.h5"
fan_out crops sample "$folder/scene.h5" --count "$COUNT" --seed "$SEED"
fan_out pairs project "$folder/crops.h5"
# Training is one job (torchrun --nproc-per-node on a node with several GPUs); --resume goes on after a kill.
[ -e "$folder/svbrdf.h5" ] ||
    "$LUNARGR" train "$folder/pairs.h5" --model "$MODEL" --epochs "$EPOCHS" --seed "$SEED" \
        --output "$folder/checkpoint.h5" --overwrite --resume
map=$folder/svbrdf.h5 calibration=$folder/calibration.json
fan_out svbrdf infer "$folder/scene.h5" "$folder/checkpoint.h5"
[ -e "$calibration" ] || "$LUNARGR" albedo "$map" "$folder/scene.h5" --output "$calibration" # once, for all shards
fan_out svbrdf_albedo albedo "$map" "$folder/scene.h5" --calibration "$calibration"
[ -e "$folder/evaluation.h5" ] ||
    "$LUNARGR" evaluate "$folder/pairs.h5" "$folder/checkpoint.h5" --output "$folder/evaluation.h5"
