//! Boards. Each file here holds every pin, DMA channel, timer and interrupt of one board; the feature of its name chooses
//! it, and its memory lies beside the workspace's manifest.

#[cfg(feature = "nucleo-f429zi")]
mod nucleo_f429zi;
mod receiver;
#[cfg(feature = "nucleo-f429zi")]
pub use nucleo_f429zi::*;
pub use receiver::{LineErrors, line_errors};
