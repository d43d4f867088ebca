"""The settings that a controller had when its rig was commissioned: a file beside the hardware file."""

from __future__ import annotations

import json
from pathlib import Path

from ctr_nlp.exceptions import HardwareError


def commissioned_file(hardware_file: str | Path) -> Path:
    """Where the settings of the rig of a hardware file are kept."""
    return Path(hardware_file).with_suffix(".commissioned.json")


def read_commissioned(hardware_file: str | Path) -> dict[str, str] | None:
    """Settings by name, None where the rig has not been commissioned; raises HardwareError."""
    path = commissioned_file(hardware_file)
    if not path.exists():
        return None
    try:
        settings = json.loads(path.read_text(encoding="utf-8"))["settings"]
        return {str(name): str(value) for name, value in settings.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as exception:
        raise HardwareError(
            f"{path} is no record of a commissioning ({exception}): delete it, and commission the rig anew"
        ) from exception


def commissioned_text(settings: dict[str, str], identity: str) -> str:
    """What the file holds; identity: what the controller tells of itself."""
    return json.dumps({"controller": identity, "settings": settings}, indent=1) + "\n"
