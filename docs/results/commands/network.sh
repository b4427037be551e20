#!/usr/bin/env bash
set -euo pipefail
# The paper's network, taught on tracked motion: two fresh sets and the bunny's test part. GAUSIM_BUNNY names the bunny.
gausim prepare synthesize --seed 271 --objects pudding_soft --sequences 8 --out data/synthetic_271
gausim prepare synthesize --seed 272 --objects flower_soft,flower_swing --sequences 8 --out data/synthetic_272
fixed='model=gausim_network plan.epochs=5'
gausim train -m data=test/object data.root=data/synthetic_272/flower_soft,data/synthetic_272/flower_swing $fixed seed=302 \
  name=network/flowers
gausim train data=test/object data.root=data/synthetic_271/pudding_soft $fixed optimizer.decay.network=0 seed=301 name=network/pudding
gausim train data=test/bunny data.part=null data.sequences=[seq_004,seq_005,seq_006,seq_007,seq_008,seq_009,seq_010,seq_011] $fixed \
  seed=302 name=network/bunny
shopt -s globstar
for finished in outputs/network/**/FINISHED; do gausim evaluate "$(dirname "$finished")" --test --trials 45; done
gausim report outputs/network --record outputs/network.json
