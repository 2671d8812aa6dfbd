"""The README's Python examples run, and find what their comments say."""

import re
from pathlib import Path

README = Path(__file__).resolve().parents[1] / "README.md"


def test_examples_run_in_order() -> None:
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.DOTALL)
    assert len(blocks) >= 3
    names: dict = {}
    for block in blocks:
        exec(compile(block, str(README), "exec"), names)
    assert names["estimate"].mean.shape == (200, 2)
    # the example's track accelerates steadily: the last speed is known
    sigma = float(names["estimate"].cov[-1, 1, 1]) ** 0.5
    assert abs(float(names["estimate"].mean[-1, 1]) - 0.04 * 199) < 3 * sigma
    assert names["study"].rows.shape == (100, 2)
    # one track of 200 fixes: a factor of two is about two standard errors
    assert 0.25 < float(names["found"].params["q"]) < 1.0
    assert 2.8 < float(names["found"].params["r"]) < 5.6
