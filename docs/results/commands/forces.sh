#!/usr/bin/env bash
set -euo pipefail
# 1,000 frames without forces and after pushes. GAUSIM_BUNNY names the bunny.
gausim train -m data=bunny name=forces seed=271,272
for run in outputs/forces/none/gausim/seed_*; do python -m benchmarks.endurance "$run" 1000; done
