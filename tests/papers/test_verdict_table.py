"""The table of claims in a study's report: the engine's verdicts on rows in memory."""

import numpy as np

from vehest_papers.kit.block_errors import blocks_of, read_blocks
from vehest_papers.kit.block_rows import BlockRow, TrainingRow, frame
from vehest_papers.kit.claim_files import claims_of
from vehest_papers.kit.verdict_table import claims_table


def planted():
    """NNTF_UH has half the loss of GRU in each of 20 sequences, three seeds each."""
    rng = np.random.default_rng(0)
    return [
        BlockRow("real", name, seed, "tyre_a", "mse_weighted", f"b{block}", value, 100.0)
        for name, level in (("NNTF_UH", 0.5), ("GRU", 1.0), ("zero", 40.0))
        for seed in range(3)
        for block, value in enumerate(level * np.exp(0.3 * rng.normal(size=20)))
    ]


def test_rows_in_memory_are_judged_as_their_file(tmp_path):
    rows = planted()
    frame(rows, BlockRow).to_csv(tmp_path / "blocks.csv", index=False)
    memory = blocks_of(rows)
    for key, errors in read_blocks(tmp_path / "blocks.csv").items():
        assert np.array_equal(errors.sums, memory[key].sums)
        assert (errors.seeds, errors.blocks) == (memory[key].seeds, memory[key].blocks)


def test_verdict_training_and_kind_of_data_have_separate_columns():
    training = [TrainingRow("NNTF_UH", "100 + 100", "1000 + 1000", "insufficient", "")]
    table = claims_table(claims_of("learned_ukf"), planted(), training, {"real": "simulated"})
    rows = table.frame.set_index("id")
    row = rows[rows["claim"].str.contains("than GRU on the tyre used for")].iloc[0]
    assert row["verdict"] == "direction only"  # the paper has a ratio of 0.83
    assert row["training"] == "100 + 100 / 1000 + 1000, insufficient"
    assert row["data"] == "simulated, tyre_a"
    assert "ratio 0." in row["ours"]
    assert (rows["verdict"] == "not assessed").sum() > 10
    assert "direction only" in table.caption
    assert "why" not in table.columns
