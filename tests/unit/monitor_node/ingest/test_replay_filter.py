"""The filter of samples that were processed before a restart."""

from monitor_node.ingest.rows import Aligner, ReplayFilter


def test_the_filter_is_over_once_each_signal_has_passed_what_the_state_has() -> None:
    aligner = Aligner(("qc", "T"), 5)
    for number in range(3):
        for signal in ("qc", "T"):
            aligner.update(signal, 100 * number, number, 1.0)
    replay_filter = ReplayFilter(aligner.memory)
    assert all(replay_filter.is_duplicate(index, 100 * number, number) for number in range(3) for index in range(2))
    assert not any(replay_filter.is_duplicate(0, 100 * number, number) for number in (3, 4))
    assert not replay_filter.is_over  # T may still be repeated
    assert replay_filter.is_duplicate(1, 200, 2)
    assert not any(replay_filter.is_duplicate(1, 100 * number, number) for number in (3, 4))
    assert replay_filter.is_over
