#!/usr/bin/env bash
set -euo pipefail
# A cactus (any OBJ mesh), an object that no recipe was chosen on: the tutorial's commands, then two sequences by all methods.
gausim prepare blender_bunny --mesh "${1:-cactus.obj}" --name cactus --out data/cactus --sequences 10 --frames 50 --stills 60 \
  --resolution 144 144 --still-resolution 192 192 --samples 8
gausim reconstruct data/cactus --pin "below z=0.333"
gausim train data=data/cactus name=cactus
gausim evaluate outputs/cactus/seed_0
fixed='name=others evaluate=true data.sequences=[seq_000,seq_001] seed=0,1'
gausim train -m data=data/cactus model=static $fixed
gausim train -m data=data/cactus model=deformation_field,physdreamer,spring_mass,gausim plan.clock=cpu plan.max_minutes=3 $fixed
gausim report outputs/others --record outputs/others.json
