//! `tandem dflash`: shows and initialises the data flashes of a controller, as the thesis's
//! initialisation tool does. T-RED-1

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, anyhow, ensure};
use serde_json::{Value, json};
use tandem_board::{DataFlash, FlashStatus, SystemId};
use tandem_board_host::HostFlash;
use tandem_redundancy::{FlashOp, Geometry, Loaded, StateStore, SystemState};

use crate::args::{DflashArgs, DflashCommand};
use crate::failure::Failure;

/// Carries out the command and returns the text to print.
///
/// # Errors
/// If the folder does not exist, or a file is not a data flash, is in use, or cannot be written.
pub fn run(args: &DflashArgs) -> Result<String, Failure> {
    let shown = args.folder.display();
    let makes_it = matches!(args.command, DflashCommand::Init { .. });
    let there = makes_it || args.folder.is_dir();
    if !there {
        let what = anyhow!("--folder {shown}: there is no such folder");
        return Err(Failure::Usage(what));
    }
    let json_to = args.json.check().map_err(Failure::usage)?;
    match args.command {
        DflashCommand::Show => {}
        DflashCommand::Init { master } => {
            for system in SystemId::ALL {
                let state = SystemState {
                    is_master: system == master,
                    ..SystemState::factory(system)
                };
                write(&path(&args.folder, system), Some(state))?;
            }
        }
        DflashCommand::Clear { system } => {
            for system in system.map_or(SystemId::ALL.to_vec(), |system| vec![system]) {
                write(&path(&args.folder, system), None)?;
            }
        }
    }
    let (mut text, mut rows) = (String::new(), Vec::new());
    for system in SystemId::ALL {
        let path = path(&args.folder, system);
        let stored = Stored::at(&path)?;
        let _ = writeln!(text, "{system}  {}", stored.text(&path));
        rows.push(stored.json(system));
    }
    Ok(json_to.write(&rows, || text)?)
}

fn path(folder: &Path, system: SystemId) -> PathBuf {
    folder.join(format!("{system}.dflash"))
}

fn load(flash: &HostFlash) -> (StateStore, Loaded) {
    let geometry = Geometry::first_sectors(HostFlash::SECTOR_BYTES);
    StateStore::load(geometry, |offset, into| flash.read(offset, into))
}

fn wait(flash: &HostFlash) -> FlashStatus {
    while flash.status() == FlashStatus::Busy {
        std::thread::yield_now();
    }
    flash.status()
}

/// Erases the flash, and writes this state to it.
fn write(path: &Path, state: Option<SystemState>) -> anyhow::Result<()> {
    let _claimed = HostFlash::claim(path)?;
    let flash = HostFlash::open(path)?;
    let shown = path.display();
    for sector in 0..HostFlash::SECTORS {
        let erased = flash.start_erase(sector).is_ok() && wait(&flash) == FlashStatus::Idle;
        ensure!(erased, "{shown}: sector {sector} cannot be erased");
    }
    let Some(state) = state else { return Ok(()) };
    let (mut store, _) = load(&flash);
    store.request(state);
    while !store.is_settled() {
        ensure!(!store.is_broken(), "{shown}: it cannot be programmed");
        let started = match store.poll(wait(&flash)) {
            None => continue,
            Some(FlashOp::Erase { sector }) => flash.start_erase(sector),
            Some(FlashOp::Program { offset, data }) => flash.start_program(offset, &data),
        };
        if started.is_err() {
            store.refused();
        }
    }
    Ok(())
}

/// The content of a system's data flash.
enum Stored {
    /// There is no file.
    Absent,
    Blank,
    /// No record is valid.
    Lost,
    State(SystemState),
}

impl Stored {
    fn at(path: &Path) -> anyhow::Result<Self> {
        if !path.exists() {
            return Ok(Self::Absent);
        }
        let flash = HostFlash::open(path).context("reading")?;
        Ok(match load(&flash).1 {
            Loaded::State(state) => Self::State(state),
            Loaded::Blank => Self::Blank,
            Loaded::Lost => Self::Lost,
        })
    }

    fn text(&self, path: &Path) -> String {
        let state = match self {
            Self::State(state) => state,
            Self::Absent => {
                return format!("no data flash at {}: a run creates it", path.display());
            }
            Self::Blank => return "blank: the next start writes the factory state".to_owned(),
            Self::Lost => return "no valid record: `tandem dflash init` repairs it".to_owned(),
        };
        let yes = |is: bool| if is { "yes" } else { "no" };
        let SystemState {
            is_master,
            sys_failure,
            failure_mode,
            cpsys_failure,
            abn_resets,
            total_resets,
            abn_in_a_row,
            wrong_in_a_row,
            term,
        } = *state;
        format!(
            "master {}, own failure {} ({failure_mode:?}), other's failure {}, \
             resets {total_resets}, abnormal {abn_resets} ({abn_in_a_row} in a row), \
             wrong commands {wrong_in_a_row} in a row, term {}",
            yes(is_master),
            yes(sys_failure),
            yes(cpsys_failure),
            term.bits()
        )
    }

    /// Returns an object of the array that `--json` prints.
    fn json(&self, system: SystemId) -> Value {
        let (content, state) = match self {
            Self::Absent => ("absent", None),
            Self::Blank => ("blank", None),
            Self::Lost => ("lost", None),
            Self::State(state) => ("state", Some(state)),
        };
        let state = state.map(|it| {
            json!({
                "is_master": it.is_master,
                "own_failure": it.sys_failure,
                "failure_mode": format!("{:?}", it.failure_mode),
                "others_failure": it.cpsys_failure,
                "resets": it.total_resets,
                "abnormal_resets": it.abn_resets,
                "abnormal_resets_in_a_row": it.abn_in_a_row,
                "wrong_commands_in_a_row": it.wrong_in_a_row,
                "term": it.term.bits(),
            })
        });
        json!({ "system": system.to_string(), "content": content, "state": state })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_page::json::JsonOption;
    use tandem_redundancy::FailureMode;

    fn run_on(folder: &Path, command: DflashCommand) -> String {
        let args = DflashArgs {
            command,
            folder: folder.to_owned(),
            json: JsonOption::default(),
        };
        run(&args).unwrap()
    }

    fn state(folder: &Path, system: SystemId) -> Loaded {
        load(&HostFlash::open(&path(folder, system)).unwrap()).1
    }

    fn said(failure: Failure) -> String {
        match failure {
            Failure::Usage(error) | Failure::Run(error) => error.to_string(),
            other => panic!("{other:?}"),
        }
    }

    /// T-RED-1: `init` makes one system master and the other slave, and sets the rest to zero.
    #[test]
    fn a_suspended_system_is_revived() {
        let folder = tempfile::tempdir().unwrap();
        let suspended = SystemState {
            sys_failure: true,
            failure_mode: FailureMode::IoModule,
            abn_resets: 7,
            ..SystemState::factory(SystemId::A)
        };
        write(&path(folder.path(), SystemId::A), Some(suspended)).unwrap();
        let shown = run_on(folder.path(), DflashCommand::Show);
        assert!(shown.contains("own failure yes (IoModule)"), "{shown}");
        assert!(shown.contains("B  no data flash"), "{shown}");

        let master = SystemId::B;
        let shown = run_on(folder.path(), DflashCommand::Init { master });
        for system in SystemId::ALL {
            let expected = SystemState {
                is_master: system == master,
                ..SystemState::factory(system)
            };
            assert_eq!(
                state(folder.path(), system),
                Loaded::State(expected),
                "{shown}"
            );
        }

        let system = Some(SystemId::A);
        let shown = run_on(folder.path(), DflashCommand::Clear { system });
        assert_eq!(state(folder.path(), SystemId::A), Loaded::Blank, "{shown}");
        assert_ne!(state(folder.path(), SystemId::B), Loaded::Blank);
    }

    #[test]
    fn a_folder_that_is_not_there_is_neither_shown_nor_made() {
        let folder = tempfile::tempdir().unwrap();
        let folder = folder.path().join("mistyped");
        for command in [DflashCommand::Show, DflashCommand::Clear { system: None }] {
            let args = DflashArgs {
                command,
                folder: folder.clone(),
                json: JsonOption::default(),
            };
            let error = said(run(&args).unwrap_err());
            assert!(error.contains("no such folder"), "{error}");
            assert!(!folder.exists());
        }
    }

    #[test]
    fn the_flash_of_a_run_is_left_alone() {
        let folder = tempfile::tempdir().unwrap();
        let _run = HostFlash::claim(&path(folder.path(), SystemId::A)).unwrap();
        let args = DflashArgs {
            command: DflashCommand::Clear { system: None },
            folder: folder.path().to_owned(),
            json: JsonOption::default(),
        };
        let error = said(run(&args).unwrap_err());
        assert!(error.contains("in use"), "{error}");
    }
}
