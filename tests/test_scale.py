"""Ten million frames: what `scale.py` measures, held to what is promised."""

import pytest
import scale


@pytest.mark.slow
def test_ten_million_frames_train_like_ten_thousand():
    result = scale.record(10_000_000)
    print(result)
    large = result["large"]
    assert large["frames"] == 10_000_000
    assert large["megabytes_beyond_imports"] < 2000
    assert large["seconds"]["first_batch"] < 10
    assert result["large_over_small"]["windows_trained_per_second"] > 0.8
