"""The models by name: the package's own, those that a user registers, and those of installed packages."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Iterator, Mapping

from ctr_nlp.exceptions import OptionError
from ctr_nlp.models.dominant import Dominant
from ctr_nlp.models.elastic import Elastic
from ctr_nlp.models.loads import Load, LoadOverTime
from ctr_nlp.models.protocol import Model
from ctr_nlp.robot import Robot
from ctr_nlp.support.value_checks import check_choice
from ctr_nlp.typing import Array

MODEL_ENTRY_POINT_GROUP = "ctr_nlp.models"
"""Entry-point group under which a package offers models: name = "module:object", a Model."""


class Registry(Mapping[str, Model]):
    """Models by name; those of installed packages are loaded at the first look-up."""

    def __init__(self, *models: Model) -> None:
        self._known = {model.name: model for model in models}
        self._searched = False

    def register(self, model: Model) -> Model:
        """Make a model known under its name; raises OptionError where another one has it."""
        name = getattr(model, "name", None)
        if not isinstance(model, Model) or not isinstance(name, str) or not name:
            raise OptionError(f"a model to register is {model!r:.80}; it must be a Model with a name")
        # The same class may be registered again, as when a notebook's cell is run twice.
        if type(self._known.get(name, model)) is not type(model):
            raise OptionError(f"name of a model is {name!r}, which {self._known[name]!r} has already")
        # Later registrations replace earlier ones of the same class.
        self._known[name] = model
        return model

    def _all(self) -> dict[str, Model]:
        """All models, after the entry points have been searched."""
        # Set before loading: a package's module may itself look up a model while it is imported.
        if not self._searched:
            self._searched = True
            for entry in importlib.metadata.entry_points(group=MODEL_ENTRY_POINT_GROUP):
                if entry.name not in self._known:
                    self.register(entry.load())
        return self._known

    def __getitem__(self, name: str) -> Model:
        return self._all()[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._all())

    def __len__(self) -> int:
        return len(self._all())


DEFAULT_MODEL = "elastic"
"""Name of the model that plans are made on unless another is asked for."""
KINEMATIC_MODELS = Registry(Dominant(), Elastic())
"""Every model by the name that options use."""

register = KINEMATIC_MODELS.register


def model_named(model: str | Model, name: str = "model") -> Model:
    """Return the model of a name, or the one given; `name` is the option's, for messages. Raises OptionError."""
    if isinstance(model, Model):
        return model
    check_choice(name, model, KINEMATIC_MODELS)
    return KINEMATIC_MODELS[model]


def model_with_load(model: str | Model, load: Load | LoadOverTime) -> Model:
    """Return a model of robots under a load; raises OptionError where `model` has no loaded counterpart."""
    # The loaded rod has modules of its own, which no robot without a load needs.
    from ctr_nlp.models.loaded.model import Loaded

    described = model_named(model)
    # Loaded has the name of the elastic model, the only one with a loaded counterpart.
    if described.name != Loaded.name:
        raise OptionError(f"a load does not go with the {described.name} model; it goes with {Loaded.name}")
    return Loaded(load)


def model_for_tip_forces(model: Model, has_tip_forces: bool) -> Model:
    """Return a model, or, if has_tip_forces, its counterpart for loaded robots.

    Raises OptionError where it has none.
    """
    return model_with_load(model, Load()) if has_tip_forces and model.applied_load is None else model


def model_with_tip_forces(model: str | Model, forces: Array) -> Model:
    """Return a model of n robots, each with one of the tip forces (n, 3) in N in addition to the load of `model`.

    It is `model` itself if all forces are 0; raises OptionError where that cannot be loaded.
    """
    described = model_named(model)
    if not forces.any():
        return described
    load = described.applied_load or Load()
    model_with_load(described, load)
    # Loaded rods are imported only where there is a load, as in model_with_load.
    from ctr_nlp.models.loaded.model import TipForceModel

    return TipForceModel(load, forces)


def suits(robot: Robot, model: str | Model) -> bool:
    """Return whether a robot can be planned on a model."""
    try:
        model_named(model).check_planning(robot)
    except OptionError:
        return False
    return True
