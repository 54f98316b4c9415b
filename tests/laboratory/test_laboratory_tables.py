"""Tables of a test machine: units, and what cannot be is one line that names file, row and remedy."""

from pathlib import Path

import numpy as np
import pytest

from physics3d.laboratory.tables import read_folder, read_table

GOOD = "time [s],stretch [1],nominal stress [kPa]\n0,1,0\n1,1.1,2\n2,1.2,3\n"


def written(folder: Path, text: str, name: str = "pull.csv") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_units_and_columns_are_read(tmp_path):
    text = "# a note: of someone\n# control: stress\n# start: ramp 2.5\n"
    text += "true stress [MPa], strain [%] ,time [min]\n1,10,0\n1,20,1\n"
    test = read_table(written(tmp_path, text))
    np.testing.assert_allclose(test.time, [0, 60])
    np.testing.assert_allclose(test.deformation, [1.1, 1.2])
    np.testing.assert_allclose(test.stress, [1e6, 1e6])
    np.testing.assert_allclose(test.measured, [0.1, 0.2])
    assert (test.kind, test.control, test.lead, test.name) == ("true", "stress", 2.5, "pull")


BAD = {
    "no column of stress": GOOD.replace(",nominal stress [kPa]", "").replace(",0\n", "\n"),
    "no column of time": "stretch [1],nominal stress [Pa]\n1,0\n2,1\n",
    "no column of deformation": "time [s],nominal stress [Pa]\n1,0\n2,1\n",
    "the unit of nominal stress is [psi]": GOOD.replace("kPa", "psi"),
    "the unit of time is missing": GOOD.replace("time [s]", "time"),
    "there is a column 'force [N]'": GOOD.replace("nominal stress [kPa]", "force [N]"),
    "line 3: stretch is nan": GOOD.replace("1,1.1,2", "1,nan,2"),
    "line 3: stretch is 'much', no number": GOOD.replace("1,1.1,2", "1,much,2"),
    "line 3: stretch is '1_1', no number": GOOD.replace("1,1.1,2", "1,1_1,2"),
    "is no csv": GOOD.replace("1,1.1,2", "1,1.1," + "2" * 200_000),
    "line 3: 4 cells for 3 columns": GOOD.replace("1,1.1,2", "1,1.1,2,5"),
    "line 4: time 1 s does not increase": GOOD.replace("2,1.2,3", "1,1.2,3"),
    "columns nominal stress and true stress are both there": GOOD.replace("[kPa]", "[kPa],true stress [Pa]"),
    "line 3: the stretch is -0.1": GOOD.replace("1.1", "-0.1"),
    "mixes shear and tension": GOOD.replace("stretch", "shear"),
    "does not start at rest": GOOD.replace("0,1,0", "0,1.1,1"),
    "has 1 rows": "\n".join(GOOD.splitlines()[:2]),
    "is empty": "# nothing\n",
    "nothing is tested": GOOD.replace(",2\n", ",0\n").replace(",3\n", ",0\n"),
    "control is 'force'": "# control: force\n" + GOOD,
    "start is 'soon'": "# start: soon\n" + GOOD,
}


@pytest.mark.parametrize("message", BAD)
def test_what_cannot_be_is_one_line(tmp_path, message):
    written(tmp_path, GOOD, "a.csv")
    written(tmp_path, BAD[message])
    with pytest.raises(ValueError) as error:
        read_folder(tmp_path)
    text = str(error.value)
    assert message in text and text.startswith("pull.csv") and "\n" not in text and ";" in text


def test_what_systems_leave_beside_a_table_is_no_table(tmp_path):
    written(tmp_path, GOOD)
    for name in ("._pull.csv", "~$pull.csv", ".hidden.csv"):
        (tmp_path / name).write_bytes(b"\x00\x05\x16\x07")
    (tmp_path / "folder.csv").mkdir()
    assert [test.name for test in read_folder(tmp_path)] == ["pull"]


def test_a_folder_without_tables_is_said(tmp_path):
    with pytest.raises(ValueError, match=r"holds no \.csv; put a table"):
        read_folder(tmp_path)
    with pytest.raises(ValueError, match=r"no folder at .*; give DATA"):
        read_folder(tmp_path / "none")
