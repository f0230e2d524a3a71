// In place of codecs that no store of a run folder has.
export default undefined;
