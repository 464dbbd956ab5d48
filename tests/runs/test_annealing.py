"""The annealing record: what a process that is killed has written, and what a resumed one keeps."""

from megastep.agents.runs import annealing


def test_flushed_factors_outlive_the_process_and_later_ones_do_not(tmp_path):
    record = annealing.AnnealingRecord(tmp_path)
    for factor in (1.0, 0.75):
        record.append(factor)
    record.flush()
    record.append(0.5)
    record.file.file.close()  # as when the process is killed
    assert annealing.read(tmp_path).tolist() == [1.0, 0.75]


def test_resuming_keeps_the_factors_of_updates_made(tmp_path):
    record = annealing.AnnealingRecord(tmp_path)
    for factor in (1.0, 0.75, 0.5):
        record.append(factor)
    record.close()
    annealing.AnnealingRecord(tmp_path, 2).close()
    assert annealing.read(tmp_path).tolist() == [1.0, 0.75]
