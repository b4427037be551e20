#!/usr/bin/env bash
set -euo pipefail
# The synthetic objects of all tables: development (seed 0), and test parts of seeds 109 and 110.
gausim prepare synthesize --out data/synthetic
gausim prepare synthesize --seed 109 --out data/synthetic_109
gausim prepare synthesize --seed 110 --objects pudding_soft,flower_swing --out data/synthetic_110
