#!/usr/bin/env bash
set -euo pipefail
# Networks pretrained on 10 to 300 bodies, fitted to twelve bodies that they never had.
gausim prepare corpus --out data/corpus --bodies 312
for bodies in 300:1 100:3 30:10 10:30; do
  gausim train experiment=pretrain data.root=data/corpus data.bodies=${bodies%:*} plan.repeats=${bodies#*:} name=pretrain_${bodies%:*}
  for seen in 16 8 3; do
    gausim train experiment=pretrain_fit data.root=data/corpus init_from=outputs/pretrain_${bodies%:*}/seed_0 data.seen=$seen \
      plan.t_start=$((seen - 1)) plan.t_max=$((seen - 1)) name=pretrain_fit/${bodies%:*}_$seen
    gausim evaluate outputs/pretrain_fit/${bodies%:*}_$seen/seed_0
  done
done
python -m benchmarks.bodies outputs/pretrain_fit outputs/pretraining.png
