//! Signs the programs of a platform: `tandem exec sign`. E-4

use std::fmt::Write as _;
use std::path::PathBuf;

use anyhow::{Context as _, anyhow};
use tandem_boot_host::SigningKey;
use tandem_exec_host::manifest::Manifest;
use tandem_exec_host::trust::sign;

use crate::boot::{PRIVATE_DER, key};
use crate::failure::Failure;

/// What is signed, and by which key.
#[derive(Clone, Debug, clap::Args)]
pub struct SignArgs {
    /// The manifest; the list of parts is written beside it, as MANIFEST.parts
    manifest: PathBuf,
    /// The private key: `openssl genpkey -algorithm ed25519 -outform DER -out FILE`
    #[arg(long, value_name = "FILE")]
    key: PathBuf,
    /// The number of the key in the anchor's list, from 0
    #[arg(long, value_name = "NUMBER", default_value_t = 0)]
    key_number: u8,
    /// Raise it to retire older lists, and `lowest-counter` in the anchor after that
    #[arg(long, value_name = "NUMBER", default_value_t = 0)]
    counter: u32,
}

/// Signs, and prints each part and the public key.
///
/// # Errors
/// [`Failure::Usage`] if a file cannot be read, a part cannot be found, or a program cannot start
/// from checked bytes.
pub fn run(args: &SignArgs) -> Result<(), Failure> {
    let text = signed(args).map_err(Failure::Usage)?;
    Ok(crate::print(&text)?)
}

fn signed(args: &SignArgs) -> anyhow::Result<String> {
    let shown = args.manifest.display();
    let bytes = std::fs::read(&args.manifest).with_context(|| shown.to_string())?;
    let manifest = Manifest::read(&bytes).with_context(|| shown.to_string())?;
    let processes = manifest.processes.iter().map(|plan| plan.program.clone());
    let safe = [&manifest.safe_state.before, &manifest.safe_state.after];
    let safe = safe.into_iter().filter_map(|words| words.first());
    let programs: Vec<PathBuf> = processes.chain(safe.map(PathBuf::from)).collect();
    let key = SigningKey {
        number: args.key_number,
        seed: key(&args.key, &PRIVATE_DER)?,
    };
    let signature = |message: &[u8]| key.sign(message);
    let parts = sign(
        &args.manifest,
        &programs,
        args.counter,
        key.number,
        signature,
    );
    // The text names the reason already, which is also the source.
    let parts = parts.map_err(|error| anyhow!("{error}"))?;
    let mut text = String::new();
    for part in &parts {
        let kind = format!("{:?}", part.kind).to_lowercase();
        writeln!(
            text,
            "{kind:8} {:>10} {} {}",
            part.length, part.sha256, part.path
        )?;
    }
    let public = key.public().map(|byte| format!("{byte:02x}")).concat();
    writeln!(
        text,
        "{} parts signed by key {}: {public}",
        parts.len(),
        key.number
    )?;
    Ok(text)
}
