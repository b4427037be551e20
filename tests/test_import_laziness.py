import subprocess
import sys

HEAVY = ("torch", "lightning", "pytorch_lightning", "wandb", "viser", "hydra", "omegaconf", "numpy", "numba")
LIST_MODULES = "\nimport sys\nprint('MODULES', *sorted({name.split('.')[0] for name in sys.modules}))"


def imported_by(code: str) -> set[str]:
    run = subprocess.run([sys.executable, "-c", code + LIST_MODULES], capture_output=True, text=True, check=True)
    return set(run.stdout.splitlines()[-1].split()[1:])


def test_loads_nothing_heavy() -> None:
    words = "(['--help'], 0), (['--version'], 0), (['no-such-command'], 2)"
    code = f"import gausim; from gausim.cli.main import main; assert all(main(w) == s for w, s in ({words}))"
    modules = imported_by(f"{code}; from gausim.core.errors import ConfigError; from gausim.core import RunError")
    assert "gausim" in modules and not modules & set(HEAVY)


def test_completing_a_configuration_loads_hydra_and_no_torch() -> None:
    line = "import os; os.environ.update(COMP_LINE='gausim train model=', COMP_POINT='19')"
    modules = imported_by(f"{line}; from gausim.cli.main import main; assert main(['-sc', 'query=bash']) == 0")
    assert "hydra" in modules and not modules & {"torch", "lightning", "numpy"}


def test_core_needs_no_viewer_and_training_without_a_dashboard_imports_none() -> None:
    unwanted = {"lightning", "pytorch_lightning", "wandb", "viser", "hydra"}
    core = f"from gausim.core import GaussianScene; import sys; assert not {unwanted!r} & set(sys.modules)"
    rooms = "import gausim.compose.build, gausim.training.callbacks.panels, gausim.training.dashboards"
    modules = imported_by(f"{core}; {rooms}")
    assert "lightning" in modules and not modules & {"wandb", "mlflow"}
