#!/usr/bin/env bash
set -euo pipefail
# The bunny: its data from the Stanford mesh (bunny.obj), its rest scene, and its table. A set of the same plan as the
# published one, which another script made with Blender 4.5.15.
gausim prepare blender_bunny --mesh "${1:-bunny.obj}" --name bunny_ready --out data/bunny_ready --sequences 12 --stills 100 \
  --resolution 128 128 --still-resolution 256 256 --samples 16
gausim reconstruct data/bunny_ready --pin "below z=0.33"
export GAUSIM_BUNNY=data/bunny_ready
gausim train -m data=bunny name=bunny seed=251,252,253
for run in outputs/bunny/none/gausim/seed_*; do gausim evaluate "$run"; done
gausim report outputs/bunny --record outputs/bunny.json
