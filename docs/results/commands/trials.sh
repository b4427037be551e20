#!/usr/bin/env bash
set -euo pipefail
# Initial guesses of the methods that start from one, on two development sequences. GAUSIM_BUNNY names the bunny.
fixed='name=trials evaluate=true data.part=development data.sequences=[seq_000,seq_001] plan.clock=cpu plan.max_minutes=2'
objects='data=bunny,pudding_soft,flower_swing'
gausim train -m $objects model=gausim model.simulator.template.period=5,8,12,18 $fixed
gausim train -m $objects model=spring_mass model.method.period=5,8,12,18 $fixed
gausim train -m $objects model=physdreamer model.method.material.young_modulus=1e4,1e5,1e6,4e6 $fixed
gausim report outputs/trials --record outputs/trials.json
