"""A token for each shown picture; what is hidden, NaN or not, changes none."""

import math

import pytest
import torch

from lerobot_unimask.networks.vision import CameraEncoder

B, K, SHAPE, D = 2, 4, (3, 64, 64), 16


@pytest.fixture(scope="module", params=[(None, True), (None, False), ("resnet18", True)], ids=str)
def encoder(request):
    torch.manual_seed(0)
    backbone, fine = request.param
    return CameraEncoder(SHAPE, D, backbone, fine=fine)


@pytest.fixture
def shown():
    return torch.tensor([[True, False, True, False], [False, True, False, False]])


def test_hidden_pictures_are_not_looked_at(encoder, shown):
    pictures = torch.rand(B, K, *SHAPE)
    tokens = encoder(pictures, shown)
    pictures[~shown] = torch.nan
    assert torch.equal(encoder(pictures, shown), tokens)
    assert (tokens[~shown] == 0).all()
    assert tokens.shape == (B, K, D)


def test_a_token_depends_on_its_picture_only(encoder, shown):
    pictures = torch.rand(B, K, *SHAPE)
    together = encoder(pictures, torch.ones_like(shown))
    torch.testing.assert_close(encoder(pictures[:1, :1], shown[:1, :1]), together[:1, :1], atol=1e-5, rtol=1e-5)
    assert (together[0, 0] - together[1, 1]).abs().max() > 1e-4


def test_uint8_is_the_same_picture(encoder, shown):
    pictures = torch.randint(256, (B, K, *SHAPE), dtype=torch.uint8)
    torch.testing.assert_close(encoder(pictures, shown), encoder(pictures / 255, shown))


def test_only_shown_pictures_have_gradients(encoder, shown):
    pictures = torch.rand(B, K, *SHAPE, requires_grad=True)
    encoder(pictures, shown).square().sum().backward()
    assert (pictures.grad[~shown] == 0).all()
    assert (pictures.grad[shown].flatten(1).abs().amax(1) > 0).all()


def test_nothing_shown(encoder, shown):
    assert (encoder(torch.full((B, K, *SHAPE), torch.nan), torch.zeros_like(shown)) == 0).all()


def test_pictures_too_small_to_tell_apart_are_refused():
    with pytest.raises(ValueError, match="32 x 32"):
        CameraEncoder((3, 32, 32), D, "resnet18", fine=True)


def test_points_come_with_sines_and_cosines(shown):
    encoder = CameraEncoder(SHAPE, D, fine=True).eval()
    picture = torch.rand(1, 1, *SHAPE)
    with torch.no_grad():
        token = encoder(picture, shown[:1, :1])[0, 0]
        points = encoder.pool(encoder.backbone(2 * picture[0] - 1)).flatten().tolist()
        numbers = points + [f(math.pi * 2**k * x) for f in (math.sin, math.cos) for x in points for k in range(4)]
        expected = encoder.out(torch.tensor(numbers))
    torch.testing.assert_close(token, expected, atol=1e-5, rtol=1e-5)
