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

# A venv whose creation failed half-way (python3-venv missing, say) has a python but no pip.
if ! .venv/bin/python -m pip --version >/dev/null 2>&1; then
    rm -rf .venv
    "$python" -m venv .venv
fi
pip=(.venv/bin/python -m pip --disable-pip-version-check --quiet)
# Modules are compiled when they are first imported: most of what torch and transformers bring never is.
install=(install --no-compile)
locked=$(sed -n 's/^torch==//p' requirements.lock)

case "${VIPE_TORCH:-cpu}-$(uname -s)" in
    cpu-Linux) torch="torch==$locked+cpu" ;;
    *) torch="torch==$locked" ;;
esac
installed=$(.venv/bin/python -c 'from importlib.metadata import version; print("torch==" + version("torch"))' 2>/dev/null || true)
if [ "$installed" != "$torch" ]; then
    echo "Installing $torch ..."
    if ! log=$("${pip[@]}" "${install[@]}" "$torch" 2>&1); then
        "${pip[@]}" "${install[@]}" "$torch" --extra-index-url https://download.pytorch.org/whl/cpu || {
            echo "$log" >&2
            exit 1
        }
    fi
fi

extras=$(IFS=,; echo "$*")
echo "Installing vipe-cluster${extras:+[$extras]} and its dependencies ..."
"${pip[@]}" "${install[@]}" --constraint requirements.lock --editable ".${extras:+[$extras]}"
