"""What fails in promises.py is shown as in a test."""

import pytest

pytest.register_assert_rewrite("tests.docs.promises")
