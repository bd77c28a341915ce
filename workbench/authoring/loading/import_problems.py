"""Why a module of the author's cannot be imported, in a sentence that says what to do."""

from __future__ import annotations

import dataclasses
import difflib
import sys
import traceback
from pathlib import Path

from workbench.authoring.loading import registry
from workbench.authoring.loading.library_names import (
    files_named_like_libraries,
    is_own_file,
    named_like_library,
)
from workbench.authoring.loading.modules import AuthorFinder
from workbench.authoring.loading.reference import NamedModule
from workbench.authoring.problem import Problem, TaskError, problem_from_exception


def import_problem(exc: BaseException, finder: AuthorFinder) -> Problem:
    """What `exc` says to the author of the file that was being imported."""
    if isinstance(exc, TaskError):
        return exc.problem
    problem = problem_from_exception(exc, "import", [Path(path) for path in finder.texts])
    message = problem.message
    if isinstance(exc, registry.DuplicateName):
        message = str(exc)
    elif isinstance(exc, SystemExit):
        message = (
            f"the file ended the program (SystemExit: {exc.code}) while being imported; what is only for "
            'running it as a script belongs under `if __name__ == "__main__":`'
        )
    elif isinstance(exc, ModuleNotFoundError) and exc.name:
        message = f"{message}; {_module_hint(exc.name, finder)}"
    elif isinstance(exc, ImportError) and (file := _named_like(exc.name, finder)) is not None:
        message = f"{message}; {named_like_library(file)}"
    elif isinstance(exc, OSError) and exc.filename == str(finder.file) and problem.file is None:
        message = f"{finder.file} cannot be read: {exc.strerror}; is it being written just now?"
    if problem.file is None:
        # Nothing of the author's ran yet, but it is this file that cannot be had.
        problem = dataclasses.replace(problem, file=str(finder.file))
    return dataclasses.replace(problem, message=message)


def named_module_problem(exc: BaseException, module: NamedModule) -> Problem:
    """The same of a module that was named in words and is imported as Python does it."""
    folder = module.own_folder or module.file.parent
    files = [Path(frame.filename) for frame in traceback.extract_tb(exc.__traceback__)]
    if isinstance(exc, SyntaxError) and exc.filename is not None:
        files.append(Path(exc.filename))
    own = [file for file in files if file == module.file or is_own_file(str(file), folder)]
    problem = problem_from_exception(exc, "import", own)
    message = f"{module.name} cannot be imported: {problem.message}"
    return dataclasses.replace(problem, message=message, file=problem.file or str(module.file))


def _named_like(name: str | None, finder: AuthorFinder) -> Path | None:
    """The author's file that was meant, where a library has its name."""
    top = (name or "").partition(".")[0]
    return next((file for file in files_named_like_libraries(finder.search_folder) if file.stem == top), None)


def _module_hint(name: str, finder: AuthorFinder) -> str:
    if (file := _named_like(name, finder)) is not None:
        return named_like_library(file)
    top = name.partition(".")[0]
    if Path(f"{top}.py").is_file() or Path(top, "__init__.py").is_file():
        return (
            f"there is one in the folder where the command was started, which is not searched: move {top} beside the "
            "file, or name its folder in PYTHONPATH"
        )
    beside = [path.stem for path in finder.file.parent.glob("*.py") if path != finder.file]
    if finder.only_given and name.rpartition(".")[2] in beside:
        return (
            f"{name} lies beside the file, but was not among what you were asked about; open {finder.file} by its name "
            "to run it with all that lies beside it"
        )
    close = difflib.get_close_matches(name, beside, n=1)
    if close:
        return f"there is {close[0]}.py beside the file"
    return f"neither beside the file nor installed for {sys.executable}"
