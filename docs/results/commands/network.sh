#!/usr/bin/env bash
set -euo pipefail
# The paper's network, taught on tracked motion: three test sets and the bunny's test part, two or three seeds of each object.
# GAUSIM_BUNNY names the bunny.
for number in 271 272 281; do
  gausim prepare synthesize --seed $number --objects pudding_soft,flower_soft,flower_swing --sequences 8 --out data/synthetic_$number
done
fixed='model=gausim_network plan.epochs=5'
train() { # a set, a seed and objects
  for name in "${@:3}"; do
    gausim train data=test/object data.root=data/synthetic_$1/$name $fixed seed=$2 name=network/$1/$name
  done
}
train 271 303 pudding_soft flower_swing
train 272 302 pudding_soft flower_soft flower_swing
train 281 311 pudding_soft flower_soft flower_swing
train 281 312 flower_soft
gausim train -m data=test/bunny data.part=null data.sequences=[seq_004,seq_005,seq_006,seq_007,seq_008,seq_009,seq_010,seq_011] \
  $fixed seed=302,311 name=network/bunny
shopt -s globstar
for finished in outputs/network/**/FINISHED; do
  gausim evaluate "$(dirname "$finished")" --test --trials 45
  python -m benchmarks.endurance "$(dirname "$finished")" 1000
done
gausim report outputs/network --record outputs/network.json
