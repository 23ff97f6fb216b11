"""The page about charts states what is computed."""

from tests.unit.spc.tables import BEGIN, END, PAGE, table


def test_the_table_of_the_page_is_the_one_computed() -> None:
    """If not: `python -m tests.unit.spc.tables` writes it anew."""
    assert PAGE.read_text().split(BEGIN)[1].split(END)[0] == table()
