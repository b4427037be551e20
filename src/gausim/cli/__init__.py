"""The command line: the one room that imports Hydra and builds objects from configurations."""
