#!/usr/bin/env bash
# Creates .venv with the exact versions of requirements.lock. Usage: scripts/setup.sh [EXTRA ...]
#
# torch is installed first and by itself: the CPU build carries a local version (+cpu) that the default index does not
# serve, and a plain `torch` would bring several gigabytes of CUDA libraries that nothing here needs.
# Set VIPE_TORCH=cuda to take the default build (with CUDA) instead.
set -euo pipefail
cd "$(dirname "$0")/.."

python=""
for candidate in ${PYTHON:-} python3.12 python3.11 python3; do
    if "$candidate" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 13))' 2>/dev/null; then
        python=$candidate
        break
    fi
done
if [ -z "$python" ]; then
    echo "Python 3.11 or 3.12 is needed and was not found. Name it: make setup PYTHON=/path/to/python3.11" >&2
    exit 1
fi

[ -x .venv/bin/python ] || "$python" -m venv .venv
pip=(.venv/bin/python -m pip --disable-pip-version-check --quiet)
torch=$(grep -E '^torch==' requirements.lock)

if ! .venv/bin/python -c 'import torch' 2>/dev/null; then
    echo "Installing $torch (${VIPE_TORCH:-cpu}) ..."
    if [ "${VIPE_TORCH:-cpu}" = cuda ]; then
        "${pip[@]}" install "$torch"
    else
        "${pip[@]}" install "$torch+cpu" 2>/dev/null ||
            "${pip[@]}" install "$torch+cpu" --extra-index-url https://download.pytorch.org/whl/cpu
    fi
fi

extras=$(IFS=,; echo "$*")
echo "Installing vipe-cluster${extras:+[$extras]} and its dependencies ..."
"${pip[@]}" install --constraint requirements.lock --editable ".${extras:+[$extras]}"
