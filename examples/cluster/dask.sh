#!/usr/bin/env bash
# A Dask cluster for one lunargr command: a scheduler here, workers on every node of the job, all gone at its end.
#
#   sbatch --nodes=8 --ntasks-per-node=16 examples/cluster/dask.sh project crops.h5 -o pairs.h5
#   WORKERS=4 examples/cluster/dask.sh ingest dem.tif --images images.csv --gsd 5 -o scene.h5     (without Slurm)
#
# On one machine `lunargr ... --scheduler local:4` does the same without this script. A cluster that runs already
# (Kubernetes, dask-jobqueue, ...) is named by its address: --scheduler tcp://HOST:8786.
#SBATCH --job-name=lunargr-dask
#SBATCH --cpus-per-task=1
#SBATCH --mem-per-cpu=4G
#SBATCH --time=12:00:00
#SBATCH --requeue
set -euo pipefail

if [ $# -lt 1 ]; then
    sed -n '2,8s/^# \{0,1\}//p' "$0" >&2
    exit 2
fi
: "${LUNARGR:=lunargr}" "${LUNARGR_PYTHON:=python3}" "${WORKERS:=2}"

scratch=$(mktemp -d "${TMPDIR:-$PWD}/lunargr-dask.XXXXXX") # Slurm: TMPDIR must be seen by all nodes, or unset
pids=()
finish() {
    for pid in ${pids[@]+"${pids[@]}"}; do kill "$pid" 2>/dev/null || true; done
    wait
    rm -rf "$scratch"
}
trap finish EXIT
export OMP_NUM_THREADS=${SLURM_CPUS_PER_TASK:-1} NUMBA_NUM_THREADS=${SLURM_CPUS_PER_TASK:-1}

"$LUNARGR_PYTHON" -m distributed.cli.dask_scheduler --port 0 --no-dashboard --scheduler-file "$scratch/scheduler.json" \
    >"$scratch/scheduler.log" 2>&1 &
pids+=($!)
for _ in {1..600}; do
    [ -s "$scratch/scheduler.json" ] && break
    sleep 0.1
done
address=$("$LUNARGR_PYTHON" -c 'import json, sys; print(json.load(open(sys.argv[1]))["address"])' "$scratch/scheduler.json")

worker=("$LUNARGR_PYTHON" -m distributed.cli.dask_worker "$address" --nthreads 1 --no-dashboard --memory-limit 0
    --local-directory "$scratch" --death-timeout 600)
if [ -n "${SLURM_JOB_ID:-}" ]; then
    srun --kill-on-bad-exit=0 "${worker[@]}" >"$scratch/workers.log" 2>&1 &
    pids+=($!)
else
    for ((i = 0; i < WORKERS; i++)); do
        "${worker[@]}" >"$scratch/worker.$i.log" 2>&1 &
        pids+=($!)
    done
fi
"$LUNARGR" "$@" --scheduler "$address"
