#!/usr/bin/env bash
# Training over all GPUs of several nodes; a preempted job is put back into the queue and goes on after its last epoch.
#
#   sbatch --nodes=2 --gpus-per-node=4 examples/cluster/slurm_train.sh PAIRS CHECKPOINT [OPTIONS OF lunargr train...]
#
# Without GPUs, one process on each node. Settings (environment): LUNARGR as for slurm_array.sh; torchrun is called as it is.
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
    sed -n '2,6s/^# \{0,1\}//p' "$0" >&2
    exit 2
fi
pairs=$1 checkpoint=$2
shift 2
: "${LUNARGR:=lunargr}"
[ -e "$checkpoint" ] && exit 0

nodes=${SLURM_JOB_NUM_NODES:-1}
processes=${SLURM_GPUS_ON_NODE:-1}
export OMP_NUM_THREADS=$((${SLURM_CPUS_PER_TASK:-1} / processes > 0 ? ${SLURM_CPUS_PER_TASK:-1} / processes : 1))
port=$((15000 + ${SLURM_JOB_ID:-0} % 15000)) # of its own: two trainings may share a node
head=localhost launch=()
if [ -n "${SLURM_JOB_NODELIST:-}" ]; then
    head=$(scontrol show hostnames "$SLURM_JOB_NODELIST" | head -n 1)
    launch=(srun --kill-on-bad-exit=1)
fi
read -r -a torchrun <<<"${LUNARGR%lunargr}torchrun"
# The batch counts pairs over all processes; --resume finds the state beside the checkpoint where there is one.
exec ${launch[@]+"${launch[@]}"} "${torchrun[@]}" --nnodes "$nodes" --nproc-per-node "$processes" \
    --rdzv-backend c10d --rdzv-endpoint "$head:$port" --rdzv-id "${SLURM_JOB_ID:-0}" \
    -m lunargr_cli.main train "$pairs" --output "$checkpoint" --resume "$@"
