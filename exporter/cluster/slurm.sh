#!/usr/bin/env bash
# Runs a table on the nodes of a Slurm job, through a Ray cluster that lasts as long as the job. From the project's root, on a file system that
# all nodes see, after `make setup cluster` and the build of lads-run there:
#     sbatch --nodes 4 --cpus-per-task 16 exporter/cluster/slurm.sh exporter/tables/kitchen.toml
# What stands behind the script goes to `python -m lads_exporter table`. The same command goes on where the time was up.
#SBATCH --job-name=lads-table
#SBATCH --output=lads-table-%j.log
#SBATCH --nodes=2
#SBATCH --ntasks-per-node=1
#SBATCH --cpus-per-task=8
#SBATCH --time=12:00:00
# The loss of a node ends neither the job nor, below, the step in which Ray runs.
#SBATCH --no-kill
# So many seconds before the end this script is told, and the trainings write their checkpoints.
#SBATCH --signal=B:TERM@180
set -euo pipefail
cd "$SLURM_SUBMIT_DIR"
source .venv/bin/activate

port=$((20000 + SLURM_JOB_ID % 10000))
RAY_ADDRESS=$(hostname):$port
# Who is on these machines besides must not reach the cluster.
RAY_AUTH_MODE=token
RAY_AUTH_TOKEN=$(python -c 'import secrets; print(secrets.token_hex(32))')
RAY_USAGE_STATS_ENABLED=0
export port RAY_ADDRESS RAY_AUTH_MODE RAY_AUTH_TOKEN RAY_USAGE_STATS_ENABLED

# One task a node; the first one, on this machine, is the head.
srun --no-kill --kill-on-bad-exit=0 --overlap bash -c '
    case $SLURM_PROCID in
        0) role="--head --port=$port --include-dashboard=false" ;;
        *) role="--address=$RAY_ADDRESS" ;;
    esac
    exec ray start $role --block --disable-usage-stats --num-cpus="$SLURM_CPUS_PER_TASK"' &
cluster=$!
for _ in $(seq 60); do
    (: >"/dev/tcp/$(hostname)/$port") 2>/dev/null && break
    sleep 1
done

python -m lads_exporter table --engine ray --jobs $((SLURM_NNODES * SLURM_CPUS_PER_TASK)) "$@" &
table=$!
trap 'kill -TERM $table' TERM
code=0
# A signal ends `wait` before the table has ended.
while kill -0 $table 2>/dev/null; do wait $table && code=0 || code=$?; done
kill $cluster 2>/dev/null || true
exit $code
