#!/usr/bin/env bash
# All that is measured on a machine with a GPU, from a checkout, the most important first:
#
#     benchmarks/gpu.sh [--out FOLDER] [--minutes 45] [--device cuda] [--small]
#
# coliags check installation; the tests marked gpu; rasterizers, their speed and their differences; a training step of
# each method; frames per second; a comparison over all GPUs; and whole runs of each method on a phantom, as many as
# there is time for.
# FOLDER, gpu-results by default, gets summary.md, parts.jsonl with status and seconds of each part, the messages of each
# part in PART.log, its figures in PART.json, and the report of the runs. A part that fails does not end the others.
# PYTHON names the interpreter; nothing is installed. --small, of sizes that take seconds, is for tests of this file.
set -uo pipefail
out=gpu-results minutes=45 device=cuda small=
while (($#)); do
  case $1 in
    --out) out=$2; shift 2 ;;
    --minutes) minutes=$2; shift 2 ;;
    --device) device=$2; shift 2 ;;
    --small) small=yes; shift ;;
    *) echo "unknown option $1; known: --out FOLDER, --minutes N, --device NAME, --small" >&2; exit 2 ;;
  esac
done
mkdir -p "$out" && out=$(cd "$out" && pwd) || exit 2
cd "$(dirname "$0")/.." || exit 2
python=${PYTHON:-python} started=$SECONDS reserve=120  # seconds kept for the report
export PYTHONPATH="$PWD${PYTHONPATH:+:$PYTHONPATH}"
coliags=("$python" -c 'from coliags_plugin.cli import main; main()')
: >"$out/parts.jsonl"
printf '# Measurements\n\n%s, device %s, %s\n\n| part | status | seconds |\n|---|---|---|\n' \
  "$(git describe --always --dirty 2>/dev/null)" "$device" "$(date -u +%FT%RZ)" >"$out/summary.md"
details=$out/details.md
: >"$details"

# part NAME SECONDS COMMAND...: run it for at most so many seconds, and no longer than there is time.
part() {
  local name=$1 limit=$2 began=$SECONDS code=0 status
  shift 2
  local left=$((minutes * 60 - reserve - (SECONDS - started)))
  ((limit > left)) && limit=$left
  if ((limit < 10)); then
    status="no time left"
  else
    echo "$name ..." >&2
    timeout --signal=INT --kill-after=30 "$limit" "$@" >"$out/$name.log" 2>&1 || code=$?
    case $code in 0) status=ok ;; 124 | 130 | 137) status="cut off" ;; *) status="failed ($code)" ;; esac
    printf '\n## %s: %s\n\n```text\n%s\n```\n' "$name" "$status" "$(tail -n 45 "$out/$name.log" | cut -c 1-1000)" >>"$details"
  fi
  printf '{"part": "%s", "status": "%s", "seconds": %d}\n' "$name" "$status" $((SECONDS - began)) >>"$out/parts.jsonl"
  printf '| %s | %s | %d |\n' "$name" "$status" $((SECONDS - began)) >>"$out/summary.md"
  [[ $status == ok ]]
}

counts=100000,300000,1000000 reference=100000 repeats=25 gaussians=50000 step=15 size=338x270 anchors=20000,100000 frames=16
run=() brief=300 phantom=()
if [[ $small ]]; then
  counts=300 reference=300 repeats=1 gaussians=300 step=1 size=48x36 anchors=300 frames=3 run=(--steps 2) brief=2
  phantom=(--size 48x38 --frames 9 --rotation-views 2 --set mesh_spacing=3.0 --set texture_spacing=1.0)
fi
# The first methods are those that others are variants of; reim-nerf takes longest.
methods=(coliags 3dgs scaffold-gs-depth 2dgs coliags-plus)
for file in method_configs/*.yaml; do
  name=$(basename "$file" .yaml)
  [[ " ${methods[*]} reim-nerf " == *" $name "* ]] || methods+=("$name")
done
methods+=(reim-nerf)
[[ $small ]] && methods=(coliags 3dgs)

part installation 600 "${coliags[@]}" check installation --device "$device"
fast=triton pytest=(-m gpu)
if [[ $device == cpu ]]; then
  fast=cpu pytest=(--collect-only -m gpu tests/checks)
elif timeout 60 "$python" -c 'import gsplat' 2>/dev/null; then
  fast+=,gsplat
  export COLIAGS_PLUGIN_PATH=$PWD/docs/example_renderer/coliags_gsplat.py
fi
part tests 600 "$python" -m pytest -q "${pytest[@]}"
part rasterizer 300 "$python" benchmarks/rasterizer.py --device "$device" --backends "$fast" \
  --primitives gaussians3d,flat --counts "$counts" --repeats "$repeats" --json "$out/rasterizer.json"
part against-torch 300 "$python" benchmarks/rasterizer.py --device "$device" --backends "torch,${fast%,gsplat}" \
  --primitives gaussians3d,surfels --counts "$reference" --repeats "$repeats" --json "$out/against-torch.json"
for method in "${methods[@]}"; do
  part "step-$method" 120 "$python" benchmarks/train_step.py --device "$device" --methods "$method" \
    --gaussians "$gaussians" --steps "$step" --size "$size" --json "$out/step-$method.json"
done
part frames-per-second 120 "$python" benchmarks/render_fps.py --device "$device" --renderers "${fast%,gsplat}" \
  --anchors "$anchors" --frames "$frames" --size "$size" --json "$out/frames-per-second.json"
if part phantom 300 "${coliags[@]}" phantom --output "$out/phantom" --overwrite "${phantom[@]}"; then
  part comparison 300 "${coliags[@]}" compare coliags 3dgs --scenes "$out/phantom" --output "$out/comparison" \
    --device "$device" --steps "$brief"
  evaluated=()
  for method in "${methods[@]}"; do
    part "run-$method" 3600 "${coliags[@]}" train "$method" --data "$out/phantom" --output "$out/runs/$method" \
      --device "$device" --overwrite "${run[@]}" &&
      part "eval-$method" 120 "${coliags[@]}" eval "$out/runs/$method" --device "$device" &&
      evaluated+=("$out/runs/$method")
  done
  if ((${#evaluated[@]})); then
    reserve=0
    part report 120 "${coliags[@]}" report "${evaluated[@]}" --output "$out/report.html" \
      --format html markdown --overwrite
  fi
fi
cat "$details" >>"$out/summary.md"
rm "$details"
echo "$out/summary.md"
! grep -q '"failed' "$out/parts.jsonl"
