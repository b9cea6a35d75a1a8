//! The `keysplat` command.

mod cli;

fn main() -> miette::Result<()> {
    cli::main()
}
