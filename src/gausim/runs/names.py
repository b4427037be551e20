"""Names of the files in a run directory."""

CONFIG, FINISHED, FAILED = "config.yaml", "FINISHED", "FAILED"
LAST_CHECKPOINT = "last.ckpt"
EVALUATION = "evaluation/metrics.json"
EPOCHS = "epochs.csv"  # one row per epoch
MOTION = "motion.csv"  # how the prediction moves, every few epochs
MLFLOW_ID, WANDB_ID = "mlflow_id", "wandb_id"  # of the run on a dashboard, so that a resumed run goes on there
