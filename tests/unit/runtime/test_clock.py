"""The clock of a node's loop: as the machine's, but for when that is set back."""

from reactorwatch.runtime.event_loop import SteadyClock

SECOND = 1_000_000_000


class Machine:
    """A machine's clocks."""

    def __init__(self) -> None:
        self.passed_ns, self.set_ns = 0, 1_000 * SECOND

    def wall_ns(self) -> int:
        return self.set_ns + self.passed_ns

    def monotonic_ns(self) -> int:
        return self.passed_ns


def test_it_follows_the_machine_s_clock_also_when_that_is_set_forward() -> None:
    machine = Machine()
    clock = SteadyClock(machine.wall_ns, machine.monotonic_ns)
    for step_ns in (0, 1, SECOND, 3600 * SECOND):
        machine.passed_ns += SECOND
        machine.set_ns += step_ns
        assert clock.now_ns() == machine.wall_ns()


def test_when_the_machine_s_clock_is_set_back_it_runs_more_slowly_until_it_is_right_again() -> None:
    machine = Machine()
    clock = SteadyClock(machine.wall_ns, machine.monotonic_ns)
    machine.set_ns -= 60 * SECOND
    ahead = []
    for _ in range(700):
        before_ns = clock.now_ns()
        machine.passed_ns += SECOND
        assert clock.now_ns() - before_ns >= 0.9 * SECOND - 1
        ahead.append(clock.now_ns() - machine.wall_ns())
    assert ahead[0] > 59 * SECOND
    assert ahead == sorted(ahead, reverse=True)
    assert ahead[598] > 0
    assert ahead[-1] == 0
