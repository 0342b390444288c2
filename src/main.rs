//! The command line; one file per command in `commands`.

mod commands;

use std::process::ExitCode;

fn main() -> ExitCode {
    commands::main()
}
