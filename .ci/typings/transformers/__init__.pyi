# Its own file imports every model there is, which takes pyright 20 s; what it says of them is read where a module is named.
from typing import Any

def __getattr__(name: str) -> Any: ...
