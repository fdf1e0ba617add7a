#!/bin/sh
# Render a trajectory over a reflectance map; run it again to go on where it was stopped.
#   sh examples/fly_over.sh [svbrdf.h5] [trajectory.csv] [folder]
# Afterwards: python examples/film.py views/ film.webp   (or film.mp4)
# As a Slurm array each task takes its share of the views: sbatch --array=1-8 examples/fly_over.sh svbrdf.h5
set -eu
map=${1:-svbrdf.h5}
views=${2:-examples/trajectory.csv}
folder=${3:-views}
share="${SLURM_ARRAY_TASK_ID:-1}/${SLURM_ARRAY_TASK_COUNT:-1}"
lunargr render "$map" --trajectory "$views" --sun-azimuth 90 --sun-elevation 25 --size 640,480 \
    --resume --shard "$share" --json "$folder.${share%/*}.json" --output "$folder"
