#include "model.h"

typedef void (*Logger)(void *, const char *, int, const char *, const char *, ...);

typedef struct {
    Logger logger;
    void *(*allocate)(size_t, size_t);
    void (*release)(void *);
    void *finished, *environment;
} Callbacks;

const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }

void *fmi2Instantiate(const char *name, int type, const char *guid, const char *place, const Callbacks *callbacks,
                      int visible, int logging)
{
    return made(callbacks->environment, (void *)callbacks->logger);
}

void fmi2FreeInstance(void *instance) { free(instance); }
int fmi2SetupExperiment(void *instance, int a, double b, double start, int c, double d) { return OK; }
int fmi2EnterInitializationMode(void *instance) { return OK; }
int fmi2ExitInitializationMode(void *instance) { return OK; }

int fmi2SetReal(Instance *instance, const uint32_t references[], size_t count, const double values[])
{
    for (size_t i = 0; i < count; i++)
        *real(&instance->state, references[i]) = values[i];
    return OK;
}

int fmi2GetReal(Instance *instance, const uint32_t references[], size_t count, double values[])
{
    for (size_t i = 0; i < count; i++)
        values[i] = *real(&instance->state, references[i]);
    return OK;
}

int fmi2SetInteger(Instance *instance, const uint32_t references[], size_t count, const int values[])
{
    for (size_t i = 0; i < count; i++)
        instance->state.fault = values[i];
    return OK;
}

int fmi2GetInteger(Instance *instance, const uint32_t references[], size_t count, int values[])
{
    for (size_t i = 0; i < count; i++)
        values[i] = (int)instance->state.count;
    return OK;
}

int fmi2SetBoolean(Instance *instance, const uint32_t references[], size_t count, const int values[])
{
    for (size_t i = 0; i < count; i++)
        instance->state.active = values[i];
    return OK;
}

int fmi2GetBoolean(Instance *instance, const uint32_t references[], size_t count, int values[])
{
    for (size_t i = 0; i < count; i++)
        values[i] = instance->state.active;
    return OK;
}

int fmi2SetString(Instance *instance, const uint32_t references[], size_t count, const char *const values[])
{
    return strcmp(values[0], "Ada") ? ERROR : OK;
}

int fmi2DoStep(Instance *instance, double time, double step, int forget)
{
    int found = stepped(&instance->state, time, step);
    if (found != OK)
        ((Logger)instance->logger)(instance->environment, "model", found, "logStatusError",
                                   "fault %d at %g s, expected %g s", instance->state.fault, time,
                                   instance->state.time);
    return found;
}

#ifdef NO_STATE
int fmi2GetFMUstate(Instance *instance, void **found) { return ERROR; }
#else
int fmi2GetFMUstate(Instance *instance, void **found) { return captured(instance, found); }
#endif

int fmi2SetFMUstate(Instance *instance, void *state)
{
    instance->state = *(State *)state;
    return OK;
}

int fmi2FreeFMUstate(Instance *instance, void **state)
{
    free(*state);
    *state = NULL;
    return OK;
}

int fmi2SerializedFMUstateSize(Instance *instance, void *state, size_t *size)
{
    *size = sizeof(State);
    return OK;
}

int fmi2SerializeFMUstate(Instance *instance, void *state, char bytes[], size_t size)
{
    memcpy(bytes, state, size);
    return OK;
}

int fmi2DeSerializeFMUstate(Instance *instance, const char bytes[], size_t size, void **state)
{
    return read_state(bytes, size, state);
}

#define NOT_CALLED(name) int name(void) { return ERROR; }
NOT_CALLED(fmi2CancelStep)
NOT_CALLED(fmi2GetBooleanStatus)
NOT_CALLED(fmi2GetDirectionalDerivative)
NOT_CALLED(fmi2GetIntegerStatus)
NOT_CALLED(fmi2GetRealOutputDerivatives)
NOT_CALLED(fmi2GetRealStatus)
NOT_CALLED(fmi2GetStatus)
NOT_CALLED(fmi2GetString)
NOT_CALLED(fmi2GetStringStatus)
NOT_CALLED(fmi2Reset)
NOT_CALLED(fmi2SetDebugLogging)
NOT_CALLED(fmi2SetRealInputDerivatives)
NOT_CALLED(fmi2Terminate)
