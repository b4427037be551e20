#!/usr/bin/env bash
set -euo pipefail
# A jelly that falls and bounces, a test seed.
gausim prepare synthesize --out data/fall --seed 109 --objects jelly_fall
gausim train -m data=data/fall/jelly_fall 'data.test={seeds: [109]}' data.part=test seed=194,195,196 plan.epochs=30 trials=558 \
  evaluate=true name=moving
gausim train data=data/fall/jelly_fall 'data.test={seeds: [109]}' data.part=test model=physdreamer seed=194 plan.clock=cpu \
  plan.max_minutes=9 trials=1 evaluate=true name=moving/physdreamer
gausim report outputs/moving --record outputs/moving.json
