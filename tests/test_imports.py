"""What importing the package pulls in."""

import subprocess
import sys


def test_import_is_light():
    code = (
        "import sys, unips_jax; "
        "heavy = {'orbax', 'grain', 'cv2', 'matplotlib', 'tyro'}; "
        "found = heavy & {name.split('.')[0] for name in sys.modules}; "
        "assert not found, found"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
