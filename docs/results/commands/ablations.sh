#!/usr/bin/env bash
set -euo pipefail
# Ablations of the neural simulator on two objects, three seeds. GAUSIM_BUNNY names the bunny.
gausim train -m experiment=tables/ablations
gausim report outputs/ablations --record outputs/ablations.json
