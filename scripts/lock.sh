#!/usr/bin/env bash
# Rewrites requirements.lock: resolves everything anew in a throw-away environment and freezes it.
set -euo pipefail
cd "$(dirname "$0")/.."
torch_version=${1:-$(sed -n 's/^torch==//p' requirements.lock)}
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3.11 -m venv "$folder/venv"
pip=("$folder/venv/bin/python" -m pip --disable-pip-version-check --quiet)
"${pip[@]}" install "torch==$torch_version+cpu" ||
    "${pip[@]}" install "torch==$torch_version+cpu" --extra-index-url https://download.pytorch.org/whl/cpu
"${pip[@]}" install ".[postgres,dev]"
{
    echo "# Exact versions of everything that the project installs. Written by scripts/lock.sh."
    "${pip[@]}" freeze | sed -E -e '/^(vipe-cluster|-e) ?/d' -e 's/^torch==([0-9.]+).*/torch==\1/' -e 's/ @ .*//' | sort -f
} >"$folder/lock"
mv "$folder/lock" requirements.lock
