import pytest
import torch
from torch.nn.functional import normalize

from vlgs.heads import Head
from vlgs.heads.identity import Identity


def test_codes_are_the_embeddings():
    head = Identity(dim=8)
    assert isinstance(head, Head)
    vectors = normalize(torch.randn(5, 8), dim=1)
    head.fit(vectors, torch.ones(5))
    assert torch.equal(head.targets(vectors), vectors)
    torch.testing.assert_close(head.decode(0.3 * vectors.reshape(5, 1, 8)), vectors[:, None])
    assert head.decode(torch.zeros(2, 8)).eq(0).all()


def test_bad_input():
    with pytest.raises(ValueError, match="dim must be 1 to 65536, got 0"):
        Identity(dim=0)
    with pytest.raises(ValueError, match="dim must be the embedding width 3, got 8"):
        Identity(dim=8).fit(torch.ones(1, 3), torch.ones(1))
