#!/usr/bin/env bash
set -euo pipefail
# The paper's simulator by the paper's schedule: a smaller network by all uses, and the whole network by half of them.
gausim train data=synthetic data.names=[flower_soft] model=gausim_paper model.simulator.network.hidden=64 \
  model.simulator.network.layers=8 model.simulator.head.zero_output=true name=paper/small evaluate=true
gausim train data=synthetic data.names=[flower_soft] model=gausim_paper model.simulator.head.zero_output=true plan.repeats=36 \
  trainer=ddp trainer.accelerator=cpu name=paper/whole evaluate=true
gausim report outputs/paper --record outputs/paper.json
