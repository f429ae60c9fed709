import importlib.metadata

import pytest

from lerobot_symview.runtime.cli import CommandError
from symview_eval import doctor


def test_a_sound_environment_needs_no_remedy():
    findings = doctor.diagnose()
    assert len(findings) == len(doctor.CHECKS)
    assert [finding for finding in findings if finding.remedy or finding.advice] == []


def test_two_opencvs_are_found(monkeypatch):
    monkeypatch.setattr(doctor, "is_installed", lambda name: name in ("opencv-python", "opencv-python-headless"))
    assert "pip uninstall opencv-python opencv-python-headless" in doctor.check_opencv().remedy


def test_a_pybullet_without_numpy_works_and_can_be_rebuilt(monkeypatch):
    from symview_sim import bullet

    monkeypatch.setattr(bullet.pybullet, "isNumpyEnabled", lambda: 0)
    finding = doctor.check_pybullet()
    assert finding.remedy == ""
    assert "--no-build-isolation" in finding.advice


def test_a_mujoco_that_cannot_draw_is_found(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setattr("mujoco.egl.GLContext", lambda width, height: 1 / 0)
    finding = doctor.check_mujoco()
    assert finding.text == "MuJoCo cannot draw without a screen by egl: division by zero"
    assert "libegl1" in finding.remedy


@pytest.mark.parametrize("name", ["escnn", "pybullet", "mujoco"])
def test_absent_optional_packages_are_no_failure(monkeypatch, capsys, name):
    monkeypatch.setattr(doctor, "is_installed", lambda package: package != name)
    check = getattr(doctor, f"check_{name}")
    finding = check()
    assert finding.remedy == ""
    assert f"{name} is not installed" in finding.text
    assert "pip install" in finding.advice
    monkeypatch.setattr(doctor, "diagnose", lambda: [finding])
    doctor.doctor(doctor.DoctorConfig())
    assert capsys.readouterr().out.startswith("--  ")


def test_a_lerobot_of_another_release_is_found(monkeypatch):
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "0.5.1")
    assert "lerobot" in doctor.check_lerobot().remedy


def test_a_check_that_raises_is_a_finding_with_a_remedy(monkeypatch, capsys):
    def check_gears():
        raise ImportError("no gears")

    findings = doctor.diagnose((check_gears,))
    monkeypatch.setattr(doctor, "diagnose", lambda: findings)
    with pytest.raises(CommandError, match="1 of 1 checks failed"):
        doctor.doctor(doctor.DoctorConfig())
    output = capsys.readouterr().out
    assert "gears: ImportError: no gears" in output
    assert "remedy" in output
