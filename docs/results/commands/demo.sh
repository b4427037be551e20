#!/usr/bin/env bash
set -euo pipefail
# The demo.
make demo
gausim report outputs/demo --record outputs/demo.json
