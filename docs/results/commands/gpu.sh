#!/usr/bin/env bash
set -euo pipefail
# The bunny by a network of the paper's size, on a GPU. GAUSIM_BUNNY names the bunny.
gausim train -m data=bunny trainer=gpu model.simulator.rollout.cuda_graph=true model.simulator.network.layers=16 \
  model.simulator.network.hidden=128 seed=201,202,203 plan.epochs=30 plan.max_minutes=4.8 trainer.panel_epochs=0 doctor=false name=gpu
for run in outputs/gpu/none/gausim/*/seed_*; do gausim evaluate "$run"; done
gausim report outputs/gpu --record outputs/gpu.json
