#!/usr/bin/env bash
set -euo pipefail
# New pushes of the bunny: three sequences that training did not have. GAUSIM_BUNNY names the bunny.
gausim train -m data=bunny data.sequences=9 plan.batch_size=3 name=pushes seed=121,122,123
for run in outputs/pushes/none/gausim/*/seed_*; do
  gausim evaluate "$run"
  gausim adapt "$run" --sequences seq_009 seq_010 seq_011 --frames 16 --out "$run/new"
done
gausim report outputs/pushes --record outputs/pushes.json
