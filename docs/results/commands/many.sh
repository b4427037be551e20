#!/usr/bin/env bash
set -euo pipefail
# Error against the number of training sequences, and on three further sequences.
gausim prepare synthesize --objects pudding_soft --sequences 33 --out data/many
gausim train -m experiment=tables/data_efficiency data.root=data/many seed=0
for run in outputs/data_efficiency/*/*/*/seed_0; do
  gausim adapt "$run" --data data/many/pudding_soft --sequences seq_030 seq_031 seq_032 --frames 16 --out "$run/new"
done
gausim report outputs/data_efficiency --record outputs/many.json
