#!/bin/bash
# Styles over ACT and diffusion through PushT's camera on one GPU, in at most 8 minutes.
#
#   benchmarks/gpu.sh DATASET [OUTPUT]          DATASET: PushT's human demonstrations as a LeRobotDataset v3
#   TINY=1 DEVICE=cpu benchmarks/gpu.sh ...     the same with tiny networks and a few steps, without a GPU
#
# It checks that CPU and GPU agree on a batch, trains the recipes configs/zbc_act_pusht.yaml and
# configs/wzbc_diffusion_pusht.yaml (bf16) and the plain policies with the same options beside them, prints
# their steps per second, and rolls PushT out with each style policy. Every part has its time limit.
set -euo pipefail
cd "$(dirname "$0")/.."
DATASET=$(realpath "${1:?give the folder of the dataset}")
OUTPUT=${2:-outputs/gpu}
DEVICE=${DEVICE:-cuda}
PYTHON=${PYTHON:-python}
BIN=$(dirname "$(command -v "$PYTHON")")
export HF_HUB_OFFLINE=1
TRAIN_S=75 EVAL_S=50 # seconds of each of four trainings and two evaluations

STEPS=1000000 LOG=50 # as many steps as the time allows
SMALL_act="" SMALL_diffusion=""
if [ -n "${TINY:-}" ]; then
    STEPS=4 LOG=2 TRAIN_S=400 EVAL_S=400
    SMALL_act="dim_model=16 n_heads=2 dim_feedforward=16 n_encoder_layers=1"
    SMALL_diffusion="down_dims=[16,32] n_groups=4 num_train_timesteps=10 num_inference_steps=2"
fi

plain() { # flags of the policy without styles that has a recipe's options
    "$PYTHON" - "$1" <<'PYTHON'
import json, sys
import yaml
policy = yaml.safe_load(open(sys.argv[1]))["policy"]
for key, value in {**policy["backbone"], **{k: policy[k] for k in ("use_amp", "input_features")}}.items():
    print(f"--policy.{key}={value if isinstance(value, str) else json.dumps(value)}")
PYTHON
}

train() { # name kind prefix-of-the-network's-options flags...
    local name=$1 kind=$2 prefix=$3 small="SMALL_$2" tiny=()
    shift 3
    for option in ${!small}; do tiny+=("--$prefix.$option"); done
    # A step after the time limit ends the run; the checkpoint is the last one before.
    timeout --signal=INT "$TRAIN_S" "$BIN/lerobot-train" "$@" "${tiny[@]}" \
        --"$prefix".pretrained_backbone_weights=null `# of the internet; the time is the same without` \
        --policy.device="$DEVICE" --policy.push_to_hub=false \
        --dataset.repo_id=local/pusht --dataset.root="$DATASET" --dataset.video_backend=pyav \
        --batch_size="${BATCH:-64}" --num_workers="${WORKERS:-8}" --steps="$STEPS" --save_freq="${SAVE:-200}" \
        --log_freq="$LOG" --seed=1000 --output_dir="$OUTPUT/$name" > "$OUTPUT/$name.log" 2>&1 || true
    "$PYTHON" - "$name" "$OUTPUT/$name.log" <<'PYTHON'
import re, sys
name, log = sys.argv[1], open(sys.argv[2]).read()
times = [(float(u), float(d)) for u, d in re.findall(r"updt_s:([\d.]+) data_s:([\d.]+)", log)][1:]
if not times:
    sys.exit(f"{name}: no step was logged; see {sys.argv[2]}:\n{log[-1500:]}")
update, data = (sum(column) / len(times) for column in zip(*times))
losses = re.findall(r"loss:([\d.]+)", log)
print(f"{name:>14}: {1 / update:7.1f} updates/s, {1 / (update + data):7.1f} steps/s with loading; "
      f"loss {losses[0]} -> {losses[-1]}", flush=True)
PYTHON
}

evaluate() { # name
    local last="$OUTPUT/$1/checkpoints/last/pretrained_model"
    [ -d "$last" ] || { echo "$1: no checkpoint was written in time"; return; }
    timeout "$EVAL_S" "$BIN/lerobot-eval" --policy.path="$last" --policy.device="$DEVICE" --env.type=pusht \
        --env.obs_type=pixels_agent_pos --env.observation_width=96 --env.observation_height=96 \
        --eval.n_episodes="${EPISODES:-10}" --eval.batch_size="${EPISODES:-10}" --eval.use_async_envs=false \
        --output_dir="$OUTPUT/$1_eval" > "$OUTPUT/$1_eval.log" 2>&1 || { tail -3 "$OUTPUT/$1_eval.log"; return; }
    "$PYTHON" -c "import json; print('$1 on PushT:', json.load(open('$OUTPUT/$1_eval/eval_info.json'))['overall'])"
}

mkdir -p "$OUTPUT"
"$PYTHON" -m benchmarks.device_agreement --dataset="$DATASET" --device="$DEVICE" ${TINY:+--tiny}
for styled in zbc_act wzbc_diffusion; do
    kind=${styled#*_}
    recipe=configs/${styled}_pusht.yaml
    mapfile -t options < <(plain "$recipe")
    train "$kind" "$kind" policy "${options[@]}"
    train "$styled" "$kind" policy.backbone --config_path="$recipe" --policy.backbone.type="$kind"
done
evaluate zbc_act
evaluate wzbc_diffusion
