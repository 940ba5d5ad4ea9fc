"""One build of the DPU: a target profile and a configuration of it."""

from dataclasses import dataclass

from profiles import TargetProfile, load_target
from profiles.constant import Constant
from profiles.errors import OptionError, ProfileError

CONFIGURATION = ("batch_handlers", "cpb", "peak_tops")
DIVISORS = ("array", "memory", "elementwise", "cost", "power")
"""Tables of widths, rates and energies, which the cost model divides by: a profile with a zero there is refused."""
SMALLEST, LARGEST = 1e-30, 1e30


@dataclass(frozen=True)
class Dpu:
    """A DPU configuration: C32B3 has 3 batch handlers, each of 32 AI engines and 32 output channels at a time."""

    target: TargetProfile
    name: str
    constants: dict[str, Constant]

    @property
    def batch(self) -> int:
        """Images that go through at once, one a batch handler."""
        return int(self.constants["batch_handlers"].low)

    @property
    def input_parallel(self) -> int:
        """Input channels that a batch handler takes in at a time."""
        return self.whole("array", "input_channel_parallel")

    @property
    def output_parallel(self) -> int:
        """Output channels that a batch handler computes at a time."""
        return int(self.constants["cpb"].low)

    @property
    def engine_ops_per_s(self) -> float:
        """Peak int8 operations a second of one batch handler; a multiply-accumulate counts as two."""
        return self.constants["peak_tops"].low * 1e12 / self.batch

    @property
    def lane_steps_per_s(self) -> float:
        """Values a second that an engine in programmable logic takes in: channels x pixels x its clock."""
        lanes = self.value("elementwise", "channels_per_cycle") * self.value("elementwise", "pixels_per_cycle")
        return lanes * self.value("array", "pl_clock_hz")

    def limit(self, table: str, key: str) -> Constant:
        """A constant of the target, with both ends of its range: a rule's window, or one limit as both."""
        return self.target.constant(table, key)

    def value(self, table: str, key: str) -> float:
        """The single value of a constant of the target."""
        return self.target.value(table, key)

    def whole(self, table: str, key: str) -> int:
        """The value of a constant that counts something."""
        return int(self.value(table, key))


def load_dpu(target: str = "vck190", configuration: str | None = None) -> Dpu:
    """Read a target profile and one of its configurations.

    Raises:
        ProfileError: unknown target or configuration, or constants that no board has.
        OptionError: a target without a DPU.
    """
    profile = load_target(target)
    if not profile.configurations:
        raise OptionError(
            "--target", expected="a target with a DPU, such as vck190", got=repr(target), remedy="choose another"
        )
    name, constants = profile.configuration(configuration)
    for key in CONFIGURATION:
        _require(f"{profile.name} [configurations.{name}] {key}", constants.get(key))
    for table in DIVISORS:
        for key, constant in profile.tables.get(table, {}).items():
            _require(f"{profile.name} [{table}] {key}", constant)
    return Dpu(profile, name, constants)


def _require(where: str, constant: Constant | None) -> None:
    if constant is None or not SMALLEST < constant.low <= constant.high < LARGEST:
        got = "none" if constant is None else str(constant)
        raise ProfileError(where, expected="a number above 0 that a board can have", got=got, remedy="correct it")
