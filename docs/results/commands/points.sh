#!/usr/bin/env bash
set -euo pipefail
# The bunny from the true motion of its points. GAUSIM_BUNNY names the bunny.
gausim train -m data=bunny supervision=points name=points seed=131,132,133
for run in outputs/points/none/gausim/*/seed_*; do gausim evaluate "$run"; done
gausim report outputs/points --record outputs/points.json
