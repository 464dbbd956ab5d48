"""The annealing record: what a process that is killed has written, and what a resumed one keeps."""

from types import SimpleNamespace

from megastep.agents.training import budget


def record(folder, *factors):
    record = budget.AnnealingRecord(folder)
    for factor in factors:
        record.on_rollout(SimpleNamespace(lr_fraction=factor), None)
    return record


def test_written_factors_outlive_the_process_and_later_ones_do_not(tmp_path):
    writer = record(tmp_path, 1.0, 0.75)
    writer.on_report(None, {})
    writer.on_rollout(SimpleNamespace(lr_fraction=0.5), None)
    writer.file.file.close()  # as when the process is killed
    assert budget.read_record(tmp_path).tolist() == [1.0, 0.75]


def test_resuming_keeps_the_factors_of_updates_made(tmp_path):
    record(tmp_path, 1.0, 0.75, 0.5).close()
    budget.AnnealingRecord(tmp_path, 2).close()
    assert budget.read_record(tmp_path).tolist() == [1.0, 0.75]
