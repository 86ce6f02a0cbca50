"""Layouts of folders with posed photos, a module each; `etsplat.data.load.Format` says what it holds."""
