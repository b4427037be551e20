#!/usr/bin/env bash
set -euo pipefail
# The embedded objects of a test seed, one run each, three seeds.
export GAUSIM_SYNTHETIC=data/synthetic_109
gausim train -m data=synthetic data.names=[flower_soft],[pudding_soft],[pudding_firm],[flower_swing],[pudding_swing] data.part=test \
  seed=191,192,193 trials=580 evaluate=true name=swings
gausim report outputs/swings --record outputs/swings.json
