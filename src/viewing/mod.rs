//! A run or its files in a browser: a server of one page and of the messages in docs/view-protocol.md.
//!
//! The page draws the Gaussians by itself (WebGL2). Whoever shows something writes the newest of it to a [`Board`]; each connection sends its
//! viewer what that viewer lacks. Nothing waits for a viewer.

mod board;
mod connection;
mod delivery;
mod error;
mod folder;
mod live;
mod packing;
mod page;
mod path;
mod pictures;
mod protocol;
mod server;

pub use board::{Board, Frames, History};
pub use delivery::Delivery;
pub use error::ViewError;
pub use folder::Finished;
pub use live::Live;
pub use packing::{PackedMap, Part, PartId};
pub use page::{Embedded, embedded};
pub use protocol::{FromViewer, Hello, Outgoing, RenderRequest};
pub use server::{DEFAULT_ADDRESS, Desk, Server, ServerOptions};
