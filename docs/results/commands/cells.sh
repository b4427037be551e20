#!/usr/bin/env bash
set -euo pipefail
# Resolution of PhysDreamer's material points, one development sequence.
fixed='data=pudding_soft data.part=development data.sequences=[seq_000] model=physdreamer evaluate=true plan.clock=cpu'
fixed="$fixed model.plan.stages.velocity.iterations=25 model.plan.stages.material.iterations=25"
gausim train $fixed name=cells/20_filled model.method.discretisation.cells=20 model.method.discretisation.filling.cells=40
gausim train $fixed name=cells/20_hollow model.method.discretisation.cells=20 model.method.discretisation.filling=null
gausim train $fixed name=cells/32_filled
gausim train $fixed name=cells/32_hollow model.method.discretisation.filling=null
gausim train $fixed name=cells/64_filled model.method.discretisation.cells=64 model.method.discretisation.filling.cells=128
gausim report outputs/cells --record outputs/cells.json
