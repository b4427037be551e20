#!/usr/bin/env bash
set -euo pipefail
# Error in unseen frames against the processor time of the training, seven objects. GAUSIM_BUNNY names the bunny.
gausim prepare synthesize --objects flower_soft,flower_swing,pudding_soft,pudding_firm --sequences 8 --out data/curves
gausim prepare synthesize --objects jelly_fall,bar_hands --sequences 8 --frames 60 --out data/curves_moving
fixed='trainer.motion_epochs=1 trainer.panel_epochs=0 doctor=false seed=0'
for name in flower_soft flower_swing pudding_soft pudding_firm; do
  gausim train data=object data.root=data/curves/$name plan.epochs=8 $fixed name=curves/${name}_8
  gausim train data=object data.root=data/curves/$name plan.epochs=30 $fixed name=curves/${name}_30
done
gausim train data=object data.root=data/curves_moving/jelly_fall plan.epochs=8 $fixed name=curves/jelly_fall_8
gausim train data=object data.root=data/curves_moving/jelly_fall plan.epochs=30 $fixed name=curves/jelly_fall_30
gausim train data=object data.root=data/curves_moving/bar_hands plan.epochs=30 $fixed name=curves/bar_hands_30
gausim train data=bunny data.part=development plan.epochs=8 $fixed name=curves/bunny_8
gausim train data=bunny data.part=development plan.epochs=30 $fixed name=curves/bunny_30
python -m benchmarks.curves outputs/curves docs/results/curves.json
