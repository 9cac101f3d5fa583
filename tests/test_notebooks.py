import nbformat
import pytest
from nbclient import NotebookClient


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of the notebook's own machinery
def test_notebooks_run_and_carry_no_output(repository):
    paths = sorted((repository / "notebooks").glob("*.ipynb"))
    assert paths
    for path in paths:
        notebook = nbformat.read(path, as_version=4)
        assert all(not cell.get("outputs") for cell in notebook.cells), f"{path}: strip the output"
        NotebookClient(notebook, timeout=300, kernel_name="python3").execute(cwd=str(path.parent))
