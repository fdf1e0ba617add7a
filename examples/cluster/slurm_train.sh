#!/usr/bin/env bash
# Training over all GPUs of several nodes; a preempted job is put back into the queue and goes on after its last epoch.
#
#   sbatch --nodes=2 --gpus-per-node=4 examples/cluster/slurm_train.sh PAIRS CHECKPOINT [OPTIONS OF lunargr train...]
#
#SBATCH --job-name=lunargr-train
#SBATCH --ntasks-per-node=1
#SBATCH --cpus-per-task=16
#SBATCH --mem=64G
#SBATCH --time=24:00:00
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --signal=TERM@60
set -euo pipefail

if [ $# -lt 2 ]; then
    sed -n '2,5s/^# \{0,1\}//p' "$0" >&2
    exit 2
fi
pairs=$1 checkpoint=$2
shift 2
: "${LUNARGR_PYTHON:=python3}" "${PORT:=29500}"

[ -e "$checkpoint" ] && exit 0
# Put back into the queue: what held the output's lock was this very job, perhaps on a node that went down.
[ "${SLURM_RESTART_COUNT:-0}" = 0 ] || rm -f "$(dirname "$checkpoint")/.$(basename "$checkpoint").lock"

nodes=${SLURM_JOB_NUM_NODES:-1}
processes=${SLURM_GPUS_ON_NODE:-1}
export OMP_NUM_THREADS=$((${SLURM_CPUS_PER_TASK:-1} / processes > 0 ? ${SLURM_CPUS_PER_TASK:-1} / processes : 1))
head=localhost launch=()
if [ -n "${SLURM_JOB_NODELIST:-}" ]; then
    head=$(scontrol show hostnames "$SLURM_JOB_NODELIST" | head -n 1)
    launch=(srun --kill-on-bad-exit=1)
fi
# The batch counts pairs over all processes; --resume finds the state beside the checkpoint where there is one.
exec ${launch[@]+"${launch[@]}"} "$LUNARGR_PYTHON" -m torch.distributed.run --nnodes "$nodes" --nproc-per-node "$processes" \
    --rdzv-backend c10d --rdzv-endpoint "$head:$PORT" --rdzv-id "${SLURM_JOB_ID:-0}" \
    -m lunargr_cli.main train "$pairs" --output "$checkpoint" --resume "$@"
