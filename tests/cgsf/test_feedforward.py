"""The method feedforward and import-weights, end to end with untrained networks."""

import numpy as np
import pytest
import torch
from click.testing import CliRunner

import cgsf
from cgsf.cli import main
from cgsf.errors import InputError
from learned.checkpoint import ModelCard, load, save
from learned.ganet import COMPACT, GANet
from learned.pwcnet import PWCNet, PWCNetConfig


@pytest.fixture
def preset(tmp_path):
    torch.manual_seed(0)
    save(GANet(COMPACT), tmp_path / "disparity.safetensors", ModelCard("random"))
    small = PWCNetConfig(pyramid=(8, 16, 16), decoder=(16, 8), context=((8, 1),), cosine=True, residual=True)
    save(PWCNet(small), tmp_path / "flow.safetensors", ModelCard("random"))
    path = tmp_path / "preset.toml"
    files = {"disparity": "disparity", "motion": "flow"}
    lines = [f"{key} = \"{tmp_path}/{name}.safetensors\"" for key, name in files.items()]
    path.write_text("\n".join(["[feedforward]", *lines]))
    return str(path)


def _images():
    return np.random.default_rng(1).integers(0, 256, (4, 40, 70, 3), np.uint8)


def test_feedforward_gives_every_map(preset):
    result = cgsf.estimate(*_images(), method="feedforward", preset=preset)
    assert result.shape == (40, 70)
    assert result.backward_flow.shape == (40, 70, 2)
    assert np.isfinite(result.state()).all()


def test_missing_weights_and_devices_are_one_line(preset, tmp_path):
    (tmp_path / "bad.toml").write_text('[feedforward]\ndisparity = "nowhere.safetensors"\n')
    with pytest.raises(InputError, match=r"no weights nowhere\.safetensors"):
        cgsf.estimate(*_images(), method="feedforward", preset=str(tmp_path / "bad.toml"))
    (tmp_path / "toaster.toml").write_text('[feedforward]\ndevice = "toaster"\n')
    with pytest.raises(InputError, match="device 'toaster' is not available"):
        cgsf.estimate(*_images(), method="feedforward", preset=str(tmp_path / "toaster.toml"))


def test_import_weights_writes_what_load_reads(tmp_path):
    from learned.published import pwcnet_names

    names = pwcnet_names(PWCNet())
    state = {names[own]: tensor for own, tensor in PWCNet().state_dict().items()}
    torch.save(state, tmp_path / "pwc.pth")
    done = CliRunner().invoke(main, ["import-weights", "pwcnet", str(tmp_path / "pwc.pth"), "--licence", "CC0"])
    assert done.exit_code == 0, done.output
    net, card = load(tmp_path / "pwc.safetensors")
    assert card.licence == "CC0"
    assert torch.equal(net.state_dict()["context.6.weight"], state["dc_conv7.weight"])


def test_import_weights_refuses_in_one_line(tmp_path):
    torch.save({"a": torch.zeros(1)}, tmp_path / "a.pth")
    refused = CliRunner().invoke(main, ["import-weights", "ganet", str(tmp_path / "a.pth")])
    assert refused.exit_code == 2
    assert "not wanted: a" in refused.output
    assert not (tmp_path / "a.safetensors").exists()
