#!/usr/bin/env bash
set -euo pipefail
# The paper's network, taught on tracked motion, on development sequences. GAUSIM_BUNNY names the bunny.
gausim train -m data=synthetic data.names=[flower_soft],[flower_swing],[pudding_soft] data.part=development model=gausim_network \
  plan.epochs=5 evaluate=true name=network
gausim train -m data=bunny data.part=development model=gausim_network plan.epochs=5 evaluate=true name=network
gausim report outputs/network --record outputs/network.json
