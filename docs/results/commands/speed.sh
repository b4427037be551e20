#!/usr/bin/env bash
set -euo pipefail
# Rendering, steps, training, interaction, clustering and data, on this machine.
python -m benchmarks all
