import pytest
from helpers.evaluations import make_quick


@pytest.fixture(scope="module")
def quick_evaluations():
    with pytest.MonkeyPatch.context() as patch:
        make_quick(patch)
        yield
