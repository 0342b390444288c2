//! Recordings: what crosses the bus, in Parquet files by table, bed and hour.
//!
//! ```text
//! DIR/TABLE/bed=NAME/hour=YYYY-MM-DDTHH/part-SEQ.parquet
//! ```
//!
//! `hour` is that of arrival, UTC; the folders are those of Hive, so that DuckDB, pandas and pyarrow see `bed` and `hour`
//! as columns. The tables are described in [`tables`].
//!
//! Crash-safe: rows gather in memory for a few seconds and become a file that is whole as soon as it has its name. Small
//! parts are merged into `part-FIRST-LAST.parquet`; the name says which parts it holds, so that a part within the range
//! of another one is a leftover of a merge that was interrupted. [`Playback`](playback::Playback) passes over leftovers
//! and the next start of a recorder removes them, those of older hours beside its work or at a later start; somebody else
//! who reads before that sees their rows twice, and one who reads while they are merged may miss a file just gone.
//!
//! Samples and estimates that the network dropped are asked for where the daemon remembers them, and take their place
//! before anything is written; see [`gaps`].
//!
//! Deliberately absent: compaction over hours, retention, an index. What a bed is worth keeping is the user's business.

mod arrival;
pub mod gaps;
pub mod layout;
pub mod merge;
pub mod playback;
pub mod recorder;
pub mod tables;
