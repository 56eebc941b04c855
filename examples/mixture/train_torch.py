"""Train on a mixture: `torchrun --nproc-per-node 2 train_torch.py CarlaSC kitti`."""

import torch
from data import mixture
from torch.nn.functional import cross_entropy
from torch.nn.parallel import DistributedDataParallel
from torch.utils.data import DataLoader, DistributedSampler

from carlasc import Augment

if __name__ == "__main__":
    torch.distributed.init_process_group("gloo")  # "nccl" on GPUs
    torch.manual_seed(0)
    augment = Augment(directions="xy", rotate_rad=3.14, scale=0.05, translate_m=0.5, seed=0)
    data = mixture(augment)
    sampler: DistributedSampler[dict[str, object]] = DistributedSampler(data)
    loader = DataLoader(data, batch_size=2, sampler=sampler, num_workers=2)
    network = DistributedDataParallel(torch.nn.Conv3d(2, 3, 3, padding=1))
    optimizer = torch.optim.Adam(network.parameters(), lr=0.02)
    for epoch in range(5):
        sampler.set_epoch(epoch)
        augment.set_epoch(epoch)
        for batch in loader:
            labels = batch["labels"].long().masked_fill(~batch["known"], -100)
            loss = cross_entropy(network(batch["occupancy"].float()), labels)
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
        if torch.distributed.get_rank() == 0:
            print(f"epoch {epoch}: loss {loss.item():.4f}")
    torch.distributed.destroy_process_group()
