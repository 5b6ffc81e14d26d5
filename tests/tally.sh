#!/usr/bin/env bash
# Runs a command whose tests are cargo's or pytest's, and closes with what was skipped, by name, and with the counts of all of them.
# usage: tests/tally.sh COMMAND...
# A test that cannot run somewhere prints `skipped: WHY` and passes; cargo shows that only with `-- --show-output`, the rest of which is
# left out here. With LADS_REQUIRE_TOOLS set, a tool or target that is missing is a failure: CI sets it where it installs them.
# Inside another tally, only the outer one speaks.
set -uo pipefail
[ $# -gt 0 ] || { echo "usage: tests/tally.sh COMMAND..." >&2; exit 2; }
[ -z "${LADS_TALLY:-}" ] || exec "$@"
export LADS_TALLY=1
# What is read by awk is written as for a file; colours stay on a terminal.
[ ! -t 1 ] || export CARGO_TERM_COLOR=${CARGO_TERM_COLOR:-always}
# mawk, Debian's awk, looks at no line before 4 KiB are there: for minutes a quiet build would show nothing.
awk=awk
case $(awk -W version 2>&1 </dev/null) in mawk*) awk="awk -W interactive" ;; esac
found=$(mktemp)
trap 'rm -f "$found"' EXIT
# shellcheck disable=SC2086
"$@" 2>&1 | $awk -v found="$found" '
  # cargo: what passing tests have printed stands between "successes:" and "failures:" or the result.
  /^successes:$/ { quiet = 1 }
  /^(failures:|test result:)/ { quiet = 0 }
  /^---- .* stdout ----$/ { test = $2 }
  /^skipped: / { skips[++n] = (quiet ? test ": " : "") substr($0, 10); missing += / is not installed|no Rust toolchain|no standard library/ }
  /^test .* \.\.\. ignored, / { why = $0; sub(/^test .* \.\.\. ignored, /, "", why); if (!ignored[why]++) first[why] = $2 }
  # pytest -rs
  /^SKIPPED \[[0-9]+\] / { line = $0; sub(/^SKIPPED \[[0-9]+\] /, "", line); skips[++n] = line; missing += / not installed|could not import/ }
  # "test result: ok. 12 passed; 0 failed; 1 ignored; ...", and of pytest "12 passed, 1 skipped in 3.4s"
  /^test result:/ { for (i = 1; i <= NF; i++) { if ($i == "passed;") p += $(i-1); if ($i == "failed;") f += $(i-1); if ($i == "ignored;") s += $(i-1) } }
  / in [0-9.]+s/ && /(passed|failed|error)/ && !/^test result:/ {
    k = split($0, part, /[ ,]+/)
    for (i = 2; i <= k; i++) { if (part[i] == "passed") p += part[i-1]; if (part[i] ~ /^(failed|errors?)$/) f += part[i-1]; if (part[i] == "skipped") s += part[i-1] }
  }
  !quiet { print; fflush() }
  END {
    print "\nNot run here:"
    for (i = 1; i <= n; i++) print "  " skips[i]
    for (why in ignored) print "  " first[why] (ignored[why] > 1 ? " and " ignored[why] - 1 " more: " : ": ") why
    print ""
    printf "%d passed, %d failed, %d skipped\n", p, f, s
    print missing + 0 > found
  }'
status=${PIPESTATUS[0]}
missing=$(cat "$found")
if [ "$status" -eq 0 ] && [ -n "${LADS_REQUIRE_TOOLS:-}" ] && [ "${missing:-0}" -gt 0 ]; then
    echo "LADS_REQUIRE_TOOLS is set, and $missing of the skips above are for a tool that is missing" >&2
    status=1
fi
exit "$status"
