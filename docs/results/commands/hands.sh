#!/usr/bin/env bash
set -euo pipefail
# A bar in two hands; new paths of the same kinds, and of new kinds.
gausim prepare synthesize --out data/hands --objects bar_hands --frames 60
gausim prepare synthesize --out data/more_hands --objects bar_hands --frames 60 --sequences 16
gausim prepare synthesize --out data/new_hands --objects bar_hands_new --frames 60
gausim train data=data/hands/bar_hands plan.t_start=4 plan.t_max=41 model.simulator.template.solid.spacing=0.05 name=hands evaluate=true
gausim adapt outputs/hands/seed_0 --data data/more_hands/bar_hands --sequences seq_008 seq_009 seq_010 seq_011 seq_012 seq_013 seq_014 seq_015 \
  --frames 4 --epochs 5 --out outputs/hands/more
gausim adapt outputs/hands/seed_0 --data data/new_hands/bar_hands_new --frames 4 --epochs 5 --out outputs/hands/new
gausim report outputs/hands --record outputs/hands.json
