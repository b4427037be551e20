"""Names of the files that callbacks and loggers keep in a run directory."""

EPOCHS = "epochs.csv"  # one row per epoch
MOTION = "motion.csv"  # how the prediction moves, every few epochs
MLFLOW_ID, WANDB_ID = "mlflow_id", "wandb_id"  # of the run on a dashboard, so that a resumed run goes on there
