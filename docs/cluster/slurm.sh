#!/usr/bin/env bash
# sbatch docs/cluster/slurm.sh rl experiment=quickstart launch=ray launch.actors=16
# Head on the first node, workers on the others, one token for all; ends with the command. What the command
# says goes to slurm-JOB.out, what Ray says to slurm-JOB-ray-NODE.out.
#SBATCH --job-name=worldloop
#SBATCH --nodes=3
#SBATCH --ntasks-per-node=1
#SBATCH --cpus-per-task=8
#SBATCH --signal=B:TERM@120
set -euo pipefail

repository=${WORLDLOOP:-$SLURM_SUBMIT_DIR}
cd "$repository"
source .venv/bin/activate
mapfile -t nodes < <(scontrol show hostnames "$SLURM_JOB_NODELIST")
head=${nodes[0]}
address=$(srun --nodes=1 --ntasks=1 -w "$head" hostname --ip-address | awk '{print $1}')
port=6379
export SRUN_CPUS_PER_TASK=$SLURM_CPUS_PER_TASK   # else steps get one CPU, SLURM 22.05 and newer

# The token is made once, in a home that all nodes share, and readable by nobody else.
export RAY_AUTH_MODE=token RAY_AUTH_TOKEN_PATH="$HOME/.ray/auth_token-$SLURM_JOB_ID"
mkdir -p "$HOME/.ray"
(umask 077; python -c 'import secrets; print(secrets.token_hex(32))' > "$RAY_AUTH_TOKEN_PATH")
trap 'ray stop --force >/dev/null 2>&1 || true; rm -f "$RAY_AUTH_TOKEN_PATH"' EXIT

log=slurm-%j-ray-%N.out
srun --nodes=1 --ntasks=1 -w "$head" --overlap --output=$log \
  ray start --head --node-ip-address="$address" --port=$port --num-cpus="$SLURM_CPUS_PER_TASK" \
  --include-dashboard=false --block &
timeout 300 bash -c "until (exec 3<>/dev/tcp/$address/$port) 2>/dev/null; do sleep 1; done"
for node in "${nodes[@]:1}"; do
  srun --nodes=1 --ntasks=1 -w "$node" --overlap --output=$log \
    ray start --address="$address:$port" --num-cpus="$SLURM_CPUS_PER_TASK" --block &
done
timeout 300 python -c 'import sys, time, ray
ray.init(address=sys.argv[1], log_to_driver=False)
while sum(node["Alive"] for node in ray.nodes()) < int(sys.argv[2]): time.sleep(1)' "$address:$port" "${#nodes[@]}"

# This script runs on the head itself, and SLURM's TERM two minutes before the end reaches the learner, which
# writes its checkpoint; submit again to go on. A step of srun would be killed at once: srun takes TERM as an
# order to end it.
python -m pipeline "$@" launch.address="$address:$port" &
run=$!
trap 'kill -TERM $run 2>/dev/null || true; wait $run' TERM
wait $run
