//! `tandem completions` and `tandem man`: the whole command line, for shells and for `man`.

use std::fs;

use clap::{Args as _, Command, CommandFactory as _};
use tandem::args::{FoxgloveArgs, RunChoice, WebArgs};
use tandem::failure::Failure;
use tandem_page::command_line::with_exit_statuses;
use tandem_page::output::OutputFolder;

use crate::args::{Cli, CompletionsArgs, ManArgs};

/// Returns the command line of `tandem`, with the arguments of the commands that other programs
/// implement. Those of `tandem bench` are left out: they are in the package of the
/// benchmarks, which builds all their peers.
fn whole() -> Command {
    let lab = Cli::command();
    let mut whole = tandem::args::Cli::command();
    let listed: Vec<String> = whole
        .get_subcommands()
        .map(|it| it.get_name().to_owned())
        .collect();
    for name in listed {
        whole = whole.mut_subcommand(&name, |command| {
            let own = lab.find_subcommand(&name);
            let about = command.get_about().cloned().unwrap_or_default();
            match &*name {
                "bench" => Command::new("bench").about(about),
                "foxglove" => FoxgloveArgs::augment_args(Command::new("foxglove")).about(about),
                "web" => WebArgs::augment_args(Command::new("web")).about(about),
                "top" => RunChoice::augment_args(Command::new("top")).about(about),
                _ => own.cloned().unwrap_or(command),
            }
        });
    }
    with_exit_statuses(whole)
}

/// Prints the script that completes the commands in this shell.
///
/// # Errors
/// If stdout cannot be written.
pub(crate) fn print_completions(args: &CompletionsArgs) -> Result<(), Failure> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut whole(), "tandem", &mut script);
    tandem::print(&String::from_utf8(script)?)?;
    Ok(())
}

/// Writes a page for each command, and for each of their commands.
///
/// # Errors
/// If the folder cannot be written.
pub(crate) fn write_pages(args: &ManArgs) -> Result<(), Failure> {
    let place = OutputFolder::check("DIR", &args.folder).map_err(Failure::usage)?;
    // The library writes to a folder only.
    let written = tempfile::tempdir()?;
    clap_mangen::generate_to(whole(), &written)?;
    let mut pages = Vec::new();
    for entry in fs::read_dir(&written)? {
        let entry = entry?;
        let name = entry.file_name().to_string_lossy().into_owned();
        pages.push((name, fs::read_to_string(entry.path())?));
    }
    place.fill(&pages)?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_page::command_line::EXIT_STATUS;
    use tandem_page::json::JsonOption;

    /// Each help text, and with it each page, ends with the exit statuses, once.
    #[test]
    fn each_help_has_the_exit_statuses() {
        fn check(command: &mut Command, path: &str) {
            let help = command.render_long_help().to_string();
            assert_eq!(help.matches(EXIT_STATUS).count(), 1, "{path}: {help}");
            assert!(help.trim_end().ends_with(EXIT_STATUS), "{path}: {help}");
            // clap adds the command `help` itself.
            let inner = command.get_subcommands_mut();
            for inner in inner.filter(|it| it.get_name() != "help") {
                let path = format!("{path} {}", inner.get_name());
                check(inner, &path);
            }
        }
        check(&mut whole(), "tandem");
    }

    /// `--json` is the same option wherever it is: FILE may be left out, and takes no argument.
    #[test]
    fn json_means_the_same_everywhere() {
        fn check(command: &Command, path: &str, found: &mut u32) {
            if let Some(json) = command
                .get_arguments()
                .find(|it| it.get_long() == Some("json"))
            {
                *found += 1;
                let files = json.get_num_args().unwrap();
                assert_eq!((files.min_values(), files.max_values()), (0, 1), "{path}");
                assert!(json.is_require_equals_set(), "{path}");
                let help = json.get_help().unwrap().to_string();
                let shared = JsonOption::augment_args(Command::new("x"));
                let shared = shared.get_arguments().next().unwrap();
                assert_eq!(help, shared.get_help().unwrap().to_string(), "{path}");
            }
            for inner in command.get_subcommands() {
                check(inner, &format!("{path} {}", inner.get_name()), found);
            }
        }
        let mut found = 0;
        let mut whole = whole();
        whole.build();
        check(&whole, "tandem", &mut found);
        assert!(found >= 20, "{found}");
    }

    /// No command is left that only passes its arguments on.
    #[test]
    fn all_arguments_are_there() {
        whole().debug_assert();
        for command in whole().get_subcommands() {
            let name = command.get_name();
            let words = command.get_arguments().find(|it| it.get_id() == "words");
            assert!(words.is_none(), "{name} passes its arguments on");
            let count = command.get_arguments().count() + command.get_subcommands().count();
            let has_none = ["bench", "publish"].contains(&name);
            assert_eq!(count == 0, has_none, "{name}");
        }
    }
}
