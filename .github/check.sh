#!/usr/bin/env bash
# The checks of action.yml: DATA is validated, and GRIDS are audited by SCANS. Both run, and the
# exit code is 1 if one of them is not sound. The output is also the summary of the job.
set -uo pipefail
summary=${GITHUB_STEP_SUMMARY:-/dev/null}
failed=0

check() { # check COMMAND ARGUMENT...
    { echo "### $*"; echo '```'; } >> "$summary"
    "$@" 2>&1 | tee -a "$summary" || failed=1
    echo '```' >> "$summary"
}

if [ -z "${DATA:-}${GRIDS:-}" ]; then
    echo "check: expected data or grids, found neither: name a data set or grids" >&2
    exit 2
fi
read -ra validate <<< "${VALIDATE_OPTIONS:-}"
read -ra audit <<< "${AUDIT_OPTIONS:-}"
if [ -n "${DATA:-}" ]; then
    check carlasc validate "$DATA" ${validate[@]+"${validate[@]}"}
fi
if [ -n "${GRIDS:-}" ]; then
    scans=${SCANS:-${DATA:-}}
    if [ -z "$scans" ]; then
        echo "check: expected scans for the grids, found none: name the scans" >&2
        exit 2
    fi
    check carlasc audit "$GRIDS" "$scans" --html "${PAGE:-audit.html}" ${audit[@]+"${audit[@]}"}
fi
exit $failed
