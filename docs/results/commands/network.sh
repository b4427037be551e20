#!/usr/bin/env bash
set -euo pipefail
# The paper's network, taught on tracked motion: a test set and the bunny's test part, three seeds. GAUSIM_BUNNY names the bunny.
gausim prepare synthesize --seed 311 --objects pudding_soft,flower_soft,flower_swing --sequences 8 --out data/synthetic_311
fixed='model=gausim_network seed=351,352,353'
for name in pudding_soft flower_soft flower_swing; do
  gausim train -m data=test/object data.root=data/synthetic_311/$name $fixed name=network/$name
done
gausim train -m data=test/bunny data.part=null data.sequences=[seq_004,seq_005,seq_006,seq_007,seq_008,seq_009,seq_010,seq_011] \
  $fixed name=network/bunny
shopt -s globstar
for finished in outputs/network/**/FINISHED; do
  gausim evaluate "$(dirname "$finished")" --test --trials 60
  python -m benchmarks.endurance "$(dirname "$finished")" 1000
done
gausim report outputs/network --record outputs/network.json
