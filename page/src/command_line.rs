//! What the command lines of all programs share: each help text ends with the exit statuses, and
//! `--json` takes its file in the same way.

use std::ffi::OsString;

use clap::{Command, Parser};

use crate::json;

/// The exit statuses of all commands. Its lines have at most 100 columns.
pub const EXIT_STATUS: &str = "\
Exit status: 0 success; 1 it failed, or a rule was broken: a collision, two masters, a bound that
was exceeded; 2 the command line, an input or this machine does not permit it, and nothing was
started; 3 nothing was heard (topics, time); 130 ended by Ctrl-C.";

/// Parses a command line whose help has the exit statuses. Prints help or an error, and exits, if
/// the arguments request it or are wrong.
pub fn parse<C: Parser>(words: impl IntoIterator<Item = OsString>) -> C {
    let mut command = with_exit_statuses(C::command());
    let words = json::joined(words);
    let matches = command.try_get_matches_from_mut(&words);
    let matches = matches.unwrap_or_else(|error| {
        if let Some(hint) = json::hint(&words).filter(|_| error.use_stderr()) {
            eprintln!("{hint}");
        }
        error.exit()
    });
    C::from_arg_matches(&matches).unwrap_or_else(|error| error.format(&mut command).exit())
}

/// Adds the exit statuses to the help of this command and of all commands in it.
#[must_use]
pub fn with_exit_statuses(command: Command) -> Command {
    let help = match command.get_after_help() {
        Some(own) => format!("{own}\n\n{EXIT_STATUS}"),
        None => EXIT_STATUS.to_owned(),
    };
    let command = command.mut_subcommands(with_exit_statuses);
    command.after_help(help)
}
