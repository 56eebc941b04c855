"""Train on a mixture with Lightning: `python train_lightning.py CarlaSC kitti`."""

import lightning
import torch
from data import mixture
from lightning.pytorch.loggers import CSVLogger
from torch.nn.functional import cross_entropy
from torch.utils.data import DataLoader

from carlasc import Augment


class Completion(lightning.LightningModule):
    """A network, its data and its loss."""

    def __init__(self) -> None:
        super().__init__()
        self.network = torch.nn.Conv3d(2, 3, 3, padding=1)
        self.augment = Augment(directions="xy", rotate_rad=3.14, scale=0.05, seed=0)

    def train_dataloader(self) -> DataLoader[dict[str, object]]:
        """Return the batches of an epoch."""
        self.augment.set_epoch(self.current_epoch)
        return DataLoader(mixture(self.augment), batch_size=2, shuffle=True, num_workers=2)

    def training_step(self, batch: dict[str, torch.Tensor], _: int) -> torch.Tensor:
        """Return the loss of a batch, in which unknown voxels do not count."""
        labels = batch["labels"].long().masked_fill(~batch["known"], -100)
        loss = cross_entropy(self.network(batch["occupancy"].float()), labels)
        self.log("loss", loss, on_step=False, on_epoch=True, sync_dist=True)
        return loss

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Return Adam."""
        return torch.optim.Adam(self.parameters(), lr=0.02)


if __name__ == "__main__":
    trainer = lightning.Trainer(
        accelerator="cpu",
        devices=2,
        strategy="ddp",
        max_epochs=5,
        reload_dataloaders_every_n_epochs=1,
        logger=CSVLogger("."),
    )
    trainer.fit(Completion())
