"""claims.yaml, blocks.csv and training.csv: read as they are, or refused in one line that names the
fault.
"""

import numpy as np
import pytest
import yaml

from vehest.data.errors import DataError, MissingError
from vehest_papers.kit.block_errors import Key, read_blocks, read_training
from vehest_papers.kit.claim_files import read_paper

PAPER = {
    "paper": "toy",
    "reference": "A. Author, A title, A journal, 2020",
    "doi": "10.1/2",
    "study": "toy",
    "recommendation": "Use it.",
    "parts": {"real": "real", "scratch": "simulated"},
    "test_sets": {"test": "Another drive"},
    "candidates": {
        "a": {"description": "the method", "epochs_paper": 100},
        "b": {"description": "the other"},
    },
    "claims": [],
    "tables": [
        {
            "table": "Table I",
            "part": "real",
            "test_set": "test",
            "rows": [{"candidate": "a", "metric": "mse", "published": 1, "unit": "1"}],
        }
    ],
}
ORDER = {
    "id": "a_below_b",
    "claim": "a is better than b.",
    "source": "Table I",
    "kind": "order",
    "candidate": "a",
    "other": "b",
    "direction": "lower",
    "part": "real",
    "test_set": "test",
    "metric": "mse",
}


def written(tmp_path, *claims, **changes):
    path = tmp_path / "claims.yaml"
    path.write_text(yaml.safe_dump(PAPER | {"claims": list(claims)} | changes), encoding="utf-8")
    return path


def test_a_paper_is_read(tmp_path):
    untestable = {
        "id": "truck",
        "claim": "It works.",
        "source": "Table 3",
        "not_testable": "private",
    }
    paper = read_paper(written(tmp_path, {**ORDER, "published": {"a": 1, "b": 2.0}}, untestable))
    assert paper.claims[0].published_ratio == 0.5
    assert paper.claims[0].names == ["a", "b"]
    assert paper.claims[1].not_testable == "private"
    assert paper.candidates["a"].epochs_paper == 100
    assert paper.tables[0].rows[0].published == 1.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "ordr"}, "kind 'ordr' is not one of: order, equal, limit, measured"),
        ({"kind": None}, "kind is missing; it is one of"),
        ({"other": None}, "other is missing, which a claim of kind order needs"),
        ({"direction": "below"}, "direction 'below' is not one of: lower, higher"),
        ({"colour": "red"}, "unknown key 'colour'"),
        ({"limit": 3}, "limit has no meaning in a claim of kind order; leave it out"),
        ({"ratio": -1}, "ratio must be above 0, candidate / other, not -1"),
        ({"ratio": "half"}, "ratio must be a number, not 'half'"),
        ({"id": "A below b"}, "id must consist of lower-case letters"),
        ({"candidate": "c"}, "'c' is not among the candidates declared at the top"),
        ({"part": "twin"}, "'twin' is not among the parts declared"),
        ({"test_set": "tset"}, "'tset' is not among the test_sets declared"),
        ({"other": "a"}, "candidate and other are both 'a'; give other_part"),
        ({"not_testable": "private"}, "kind must be left out where not_testable is given"),
        ({"kind": "equal", "direction": None, "margin": 1.5}, "margin must be between 0 and 1"),
        (
            {"kind": "equal", "direction": None, "other": None},
            "kind equal needs either other or limit",
        ),
        (
            {"kind": "limit", "other": None, "limit": 0},
            "limit must be above 0, in the metric's unit",
        ),
        (
            {
                "kind": "measured",
                "metric": None,
                "limit": 1,
                "measure": "m:f",
                "direction": "lower",
                "margin": 0.1,
            },
            "kind measured needs either direction or margin",
        ),
    ],
)
def test_a_faulty_claim_is_refused_in_a_line_with_file_claim_and_key(tmp_path, changes, message):
    entry = {key: value for key, value in (ORDER | changes).items() if value is not None}
    with pytest.raises(DataError) as caught:
        read_paper(written(tmp_path, entry))
    assert message in str(caught.value)
    assert f"claims.yaml', claim '{entry['id']}'" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_ids_are_unique_and_tables_name_declared_candidates(tmp_path):
    with pytest.raises(DataError, match="id occurs 2 times"):
        read_paper(written(tmp_path, ORDER, ORDER))
    table = PAPER["tables"][0] | {
        "rows": [{"candidate": "x", "metric": "mse", "published": 1, "unit": "1"}]
    }
    with pytest.raises(DataError, match="table 'Table I': 'x' is not among the candidates"):
        read_paper(written(tmp_path, tables=[table]))


def test_a_recommendation_rests_on_claims_of_the_file(tmp_path):
    rests_on = {"a_below_b": ["reproduced"]}
    assert read_paper(written(tmp_path, ORDER, rests_on=rests_on)).rests_on == rests_on
    with pytest.raises(DataError, match="rests_on: no claim has the id 'a_above_b'"):
        read_paper(written(tmp_path, ORDER, rests_on={"a_above_b": []}))


HEADER = "part,candidate,seed,test_set,metric,block,value,size\n"


def test_blocks_are_read(tmp_path):
    path = tmp_path / "blocks.csv"
    path.write_text(
        HEADER
        + "real,a,0,test,mse,x,1.5,10\nreal,a,0,test,mse,y,,20\n"
        + "real,a,1,test,mse,y,4,20\nreal,a,1,test,mse,x,3,10\n"
    )
    errors = read_blocks(path)[Key("real", "a", "test", "mse")]
    assert errors.blocks == ("x", "y")
    np.testing.assert_array_equal(errors.sums, [[1.5, np.nan], [3.0, 4.0]])
    np.testing.assert_array_equal(errors.sizes, [10.0, 20.0])


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (
            "real,a,0,test,mse,x,1,10\nreal,a,0,test,mse,x,1,10\n",
            "block 'x' of seed 0 of 'a'.*twice",
        ),
        (
            "real,a,0,test,mse,x,1,10\nreal,a,1,test,mse,y,1,10\n",
            "block 'y' of seed 0.*missing; write inf",
        ),
        ("real,a,0,test,mse,x,1,10\nreal,a,1,test,mse,x,1,12\n", "another size"),
        ("real,a,0,test,mse,x,much,10\n", "column 'value' holds 'much'"),
        ("real,a,0,test,mse,x,1,nan\n", "has size nan"),
    ],
)
def test_blocks_that_cannot_be_used_are_refused(tmp_path, rows, message):
    path = tmp_path / "blocks.csv"
    path.write_text(HEADER + rows)
    with pytest.raises(DataError, match=message) as caught:
        read_blocks(path)
    assert "blocks.csv" in str(caught.value)


def test_training_is_read_and_its_words_are_checked(tmp_path):
    path = tmp_path / "training.csv"
    header = "candidate,epochs,epochs_paper,training,reason\n"
    path.write_text(header + "a,100,1000,insufficient,doubling improves by 5 %\n")
    assert read_training(path)["a"].state == "insufficient"
    path.write_text(header + "a,100,1000,enough,\n")
    with pytest.raises(DataError, match="training 'enough', which is not one of: not trained"):
        read_training(path)
    with pytest.raises(MissingError):
        read_training(tmp_path / "none.csv")
