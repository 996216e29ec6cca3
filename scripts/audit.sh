#!/usr/bin/env bash
# Known vulnerabilities of the locked versions (pip-audit, in an environment of its own), then the licences.
# Ends with 0 only where every version was looked up and none has a known vulnerability.
set -euo pipefail
cd "$(dirname "$0")/.."
lock=${1:-requirements.lock}
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
.venv/bin/python -m benchmarks.licences --output /dev/null
python3.11 -m venv "$folder/venv"
if ! "$folder/venv/bin/python" -m pip --disable-pip-version-check --quiet install pip-audit; then
    echo "audit: pip-audit cannot be installed here; vulnerabilities were NOT checked" >&2
    exit 2
fi
"$folder/venv/bin/pip-audit" --requirement "$lock" --no-deps --disable-pip --progress-spinner off \
    --format json --output "$folder/report.json" 2>"$folder/log" || true
"$folder/venv/bin/python" - "$folder/report.json" "$folder/log" <<'PYTHON'
import json
import pathlib
import sys

report, log = map(pathlib.Path, sys.argv[1:])
try:
    packages = json.loads(report.read_text())["dependencies"]
except (OSError, ValueError, KeyError):
    print(log.read_text()[-500:], file=sys.stderr)
    sys.exit("audit: no advisory database answered; vulnerabilities were NOT checked")
unknown = [package["name"] for package in packages if "skip_reason" in package]
found = [(p["name"], p["version"], v["id"], v["fix_versions"]) for p in packages for v in p.get("vulns", ())]
for name, version, advisory, fixed in found:
    print(f"{name} {version}: {advisory}; fixed in {', '.join(fixed) or 'no version yet'}")
if unknown:
    print(f"audit: the advisory database here does not know {len(unknown)} of {len(packages)} versions, "
          f"{', '.join(unknown[:5])} among them; these were NOT checked", file=sys.stderr)
print(f"audit: {len(packages) - len(unknown)} of {len(packages)} versions checked, {len(found)} known vulnerabilities")
sys.exit(1 if found or unknown else 0)
PYTHON
