#!/usr/bin/env bash
set -euo pipefail
# One network for three embedded objects and the bunny, or one for each. GAUSIM_BUNNY names the bunny.
gausim train -m experiment=tables/joint seed=161
gausim report outputs/joint_or_not --record outputs/joint.json
