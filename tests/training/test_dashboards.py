"""Media of a run as files, and on TensorBoard, Weights & Biases and MLflow."""

from __future__ import annotations
