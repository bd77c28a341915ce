"""The Share tab: films, pages, sheets and datasets made from recordings (`make.py` also serves `workbench share` and
`export`), and rerun's viewer."""
