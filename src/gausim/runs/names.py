"""Names of the files in a run directory."""

CONFIG, FINISHED, FAILED = "config.yaml", "FINISHED", "FAILED"
LAST_CHECKPOINT = "last.ckpt"
EVALUATION = "evaluation/metrics.json"
TEST = "evaluation/test.json"  # looks at the test part
EPOCHS = "epochs.csv"  # one row per epoch
MOTION = "motion.csv"  # statistics of the predicted motion, every few epochs
HYDRA = ".hydra"  # Hydra's folder, also of a job that did not start a run
