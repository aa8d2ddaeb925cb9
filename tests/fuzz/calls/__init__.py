"""Wild calls of every public function (``python -m tests.fuzz.calls``)."""
