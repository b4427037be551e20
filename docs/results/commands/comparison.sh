#!/usr/bin/env bash
set -euo pipefail
# Methods on test parts: two sequences of each object, three minutes of processor time, three seeds. GAUSIM_BUNNY names the bunny.
export GAUSIM_SYNTHETIC_TEST=data/synthetic_110
small='data.sequences=[seq_000,seq_001]' large='data.sequences=[seq_010,seq_011]'
fixed='name=comparison evaluate=true'
limited="$fixed plan.clock=cpu plan.max_minutes=3 seed=0,1,2"
gausim train -m data=test/pudding_soft,test/flower_swing model=static "$small" trials=1 $fixed
gausim train -m data=test/bunny model=static "$large" trials=1 $fixed
gausim train -m data=test/pudding_soft,test/flower_swing model=deformation_field,gausim_paper "$small" trials=1 $limited
gausim train -m data=test/bunny model=deformation_field,gausim_paper "$large" trials=1 $limited
gausim train -m data=test/pudding_soft,test/flower_swing model=physdreamer "$small" model.method.material.young_modulus=1e4 trials=4 $limited
gausim train -m data=test/bunny model=physdreamer "$large" model.method.material.young_modulus=1e5 trials=4 $limited
gausim train -m data=test/pudding_soft model=spring_mass "$small" model.method.period=18 trials=4 $limited
gausim train -m data=test/flower_swing model=spring_mass "$small" model.method.period=12 trials=4 $limited
gausim train -m data=test/bunny model=spring_mass "$large" model.method.period=12 trials=4 $limited
gausim train -m data=test/pudding_soft,test/flower_swing model=gausim "$small" trials=615 $limited
gausim train -m data=test/bunny model=gausim "$large" trials=615 $limited
gausim report outputs/comparison --record outputs/comparison.json
