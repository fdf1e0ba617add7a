#!/usr/bin/env bash
# A Dask cluster for one lunargr command: a scheduler here, workers on every node of the job, all gone at its end.
#
#   sbatch --nodes=8 --ntasks-per-node=16 examples/cluster/dask.sh project crops.h5 -o pairs.h5
#   WORKERS=4 examples/cluster/dask.sh ingest dem.tif --images images.csv --gsd 5 -o scene.h5     (without Slurm)
#
# Settings (environment): WORKERS=2 without Slurm; LUNARGR as for slurm_array.sh; dask is called as it is. Whoever reaches
# a Dask scheduler can run code as you: this one answers only to holders of a key made for this run (TLS; needs openssl).
# On one machine `lunargr ... --scheduler local:4` does the same without this script. A cluster that runs already
# (Kubernetes, dask-jobqueue, ...) is named by its address: --scheduler tls://HOST:8786.
#SBATCH --job-name=lunargr-dask
#SBATCH --cpus-per-task=1
#SBATCH --mem-per-cpu=4G
#SBATCH --time=12:00:00
#SBATCH --requeue
set -euo pipefail

if [ $# -lt 1 ]; then
    sed -n '2,10s/^# \{0,1\}//p' "$0" >&2
    exit 2
fi
: "${LUNARGR:=lunargr}" "${WORKERS:=2}"
read -r -a dask <<<"${LUNARGR%lunargr}dask"
read -r -a lunargr <<<"$LUNARGR"

scratch=$(mktemp -d "${TMPDIR:-$PWD}/lunargr-dask.XXXXXX") # Slurm: TMPDIR must be seen by all nodes, or unset
pids=()
finish() {
    for pid in ${pids[@]+"${pids[@]}"}; do kill "$pid" 2>/dev/null || true; done
    wait
    rm -rf "$scratch"
}
trap finish EXIT
export OMP_NUM_THREADS=${SLURM_CPUS_PER_TASK:-1} NUMBA_NUM_THREADS=${SLURM_CPUS_PER_TASK:-1}

# One key for scheduler, workers and client, readable by its owner alone as all of the folder is.
openssl req -x509 -newkey rsa:2048 -nodes -days 30 -subj /CN=lunargr -keyout "$scratch/key.pem" -out "$scratch/cert.pem" 2>/dev/null
export DASK_DISTRIBUTED__COMM__REQUIRE_ENCRYPTION=True DASK_DISTRIBUTED__COMM__TLS__CA_FILE="$scratch/cert.pem"
for role in SCHEDULER WORKER CLIENT; do
    export "DASK_DISTRIBUTED__COMM__TLS__${role}__CERT=$scratch/cert.pem" "DASK_DISTRIBUTED__COMM__TLS__${role}__KEY=$scratch/key.pem"
done

"${dask[@]}" scheduler --protocol tls --port 0 --no-dashboard --scheduler-file "$scratch/scheduler.json" \
    >"$scratch/scheduler.log" 2>&1 &
pids+=($!)
for _ in {1..600}; do
    [ -s "$scratch/scheduler.json" ] && break
    sleep 0.1
done
address=$(sed -n 's/.*"address": "\([^"]*\)".*/\1/p' "$scratch/scheduler.json" | head -n 1)

worker=("${dask[@]}" worker "$address" --nthreads 1 --no-dashboard --memory-limit 0
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
"${lunargr[@]}" "$@" --scheduler "$address"
