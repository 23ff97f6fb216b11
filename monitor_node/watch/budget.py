"""Budget of a plant's false alarms: the alarms that share them, and the run length of each that follows."""

from collections.abc import Sequence

from monitor_node.charts.chart_design import ChartDesign, count_chance_alarms
from monitor_node.charts.drift import DriftWatch
from monitor_node.charts.shift import NAME as SHIFT
from monitor_node.charts.shift import ShiftWatch
from monitor_node.checks.stage import SignalChecks
from monitor_node.config import MonitorConfig
from monitor_node.learn.baseline import TrainingResult
from reactorwatch.arrays import Array
from reactorwatch.contract.messages_pb2 import Check
from reactorwatch.errors import InputError
from reactorwatch.spc import false_alarm_budget
from reactorwatch.spc.charts.parameters import ParameterT2
from reactorwatch.spc.training_errors import TrainingErrors


def check_promise(config: MonitorConfig, period_min: float) -> None:
    """Check that charts can keep the promised number of false alarms, with every output monitored.

    Args:
        config: settings of the monitor.
        period_min: sampling period in minutes.

    Raises:
        InputError: charts cannot keep the promise.
    """
    outputs = len(config.outputs)
    of_drift = outputs if ParameterT2.name in config.charts else 0
    alarms = count_chance_alarms(config) + SignalChecks.CHANCE_ALARMS * outputs + of_drift
    false_alarm_budget.promise_per_30_days(config.false_alarms_per_30_days, alarms, period_min)


class AlarmBudget:
    """Alarms of one plant that share its promised false alarms.

    Args:
        config: settings of the monitor.
        charts: design of the plant's charts.
        signals: signal checks of the plant.
        shift: tests of lasting steps of the plant.
        drift: drift charts of the plant.
    """

    def __init__(
        self, config: MonitorConfig, charts: ChartDesign, signals: SignalChecks, shift: ShiftWatch, drift: DriftWatch
    ) -> None:
        self._asked = config.false_alarms_per_30_days
        self._charts, self._signals, self._shift, self._drift = charts, signals, shift, drift

    def count(self, evaluated: Sequence[bool]) -> int:
        """Number of alarms that can be false alarms.

        Args:
            evaluated: for each output, True if it is evaluated.
        """
        of_signals = SignalChecks.CHANCE_ALARMS * sum(evaluated)
        return self._charts.chance_alarms + of_signals + self._count_tests(evaluated)

    def _count_tests(self, evaluated: Sequence[bool]) -> int:
        """Number of tests of lasting steps and of drift charts, each of which chance can raise an alarm of."""
        of_steps = sum(evaluated) if self._shift.is_active else 0
        return of_steps + self._drift.chance_alarms(list(evaluated))

    def share(self, evaluated: Sequence[bool], period_min: float, checks: list[Check]) -> float:
        """In-control run length of each alarm, in rows.

        Args:
            evaluated: for each output, True if it is evaluated.
            period_min: sampling period.
            checks: checks of the training; one is added where less is promised or tested than usual.

        Raises:
            InputError: the charts cannot keep the rate that the settings ask for.
        """
        promised, usual = self._promise(evaluated, period_min, checks), false_alarm_budget.USUAL_PER_30_DAYS
        count = self.count(evaluated)
        if self._asked is None and promised != usual:
            text = (
                f"{promised:.3g} false alarms in 30 days are promised instead of {usual:g}: that is the nearest that "
                f"the charts can keep for {count} alarms and rows every {period_min:.3g} min"
            )
            checks.append(Check(name="promise", result=text))
        return false_alarm_budget.share_arl0(promised, count, period_min)

    def _promise(self, evaluated: Sequence[bool], period_min: float, checks: list[Check]) -> float:
        """False alarms in 30 days that are promised; tests of steps are left out if they would make it impossible."""
        try:
            return false_alarm_budget.promise_per_30_days(self._asked, self.count(evaluated), period_min)
        except InputError:
            if not self._shift.is_active:
                raise
            self._shift.is_active = False
            why = f"{self._asked:g} false alarms in 30 days cannot be kept with more alarms"
            checks.append(Check(name=SHIFT, result=f"lasting steps are not tested for: {why}"))
            return false_alarm_budget.promise_per_30_days(self._asked, self.count(evaluated), period_min)

    def alarm_rates(self, trained: TrainingResult, evaluated: Sequence[bool], arl0: float) -> Array:
        """False alarms a row by the errors that the training may have made, shape (draws,).

        Args:
            trained: result of the training.
            evaluated: for each output, True if it is evaluated.
            arl0: run length of each alarm without a fault, in rows.
        """
        errors = TrainingErrors.draw(len(trained.learned))
        rates = self._charts.relative_rates(trained.learned, trained.e, trained.values, arl0, errors)
        rates += self._signals.relative_rates(trained.learned, evaluated, arl0, errors)
        rates += self._count_tests(evaluated)
        return rates / arl0
