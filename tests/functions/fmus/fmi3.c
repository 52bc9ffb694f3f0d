#include "model.h"

typedef void (*Logger)(void *, int, const char *, const char *);

const char *fmi3GetVersion(void) { return "3.0"; }

void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *place, bool visible, bool logging,
                                  bool events, bool early, const uint32_t *needed, size_t count, void *environment,
                                  Logger logger, void *update)
{
    return made(environment, (void *)logger);
}

void fmi3FreeInstance(void *instance) { free(instance); }
int fmi3EnterInitializationMode(void *instance, bool a, double b, double start, bool c, double d) { return OK; }
int fmi3ExitInitializationMode(void *instance) { return OK; }

int fmi3SetFloat64(Instance *instance, const uint32_t references[], size_t count, const double values[], size_t size)
{
    for (size_t i = 0; i < count; i++)
        *real(&instance->state, references[i]) = values[i];
    return OK;
}

int fmi3GetFloat64(Instance *instance, const uint32_t references[], size_t count, double values[], size_t size)
{
    for (size_t i = 0; i < count; i++)
        values[i] = *real(&instance->state, references[i]);
    return OK;
}

int fmi3GetFloat32(Instance *instance, const uint32_t references[], size_t count, float values[], size_t size)
{
    values[0] = (float)instance->state.total;
    return OK;
}

int fmi3SetUInt8(Instance *instance, const uint32_t references[], size_t count, const uint8_t values[], size_t size)
{
    instance->state.fault = values[0];
    return OK;
}

int fmi3GetUInt64(Instance *instance, const uint32_t references[], size_t count, uint64_t values[], size_t size)
{
    values[0] = instance->state.count;
    return OK;
}

int fmi3SetBoolean(Instance *instance, const uint32_t references[], size_t count, const bool values[], size_t size)
{
    instance->state.active = values[0];
    return OK;
}

int fmi3GetBoolean(Instance *instance, const uint32_t references[], size_t count, bool values[], size_t size)
{
    values[0] = instance->state.active;
    return OK;
}

int fmi3SetString(Instance *instance, const uint32_t references[], size_t count, const char *const values[],
                  size_t size)
{
    return strcmp(values[0], "Ada") ? ERROR : OK;
}

int fmi3DoStep(Instance *instance, double time, double step, bool forget, bool *event, bool *ended, bool *early,
               double *until)
{
    int found = stepped(&instance->state, time, step);
    if (found != OK)
        ((Logger)instance->logger)(instance->environment, found, "logStatusError", "it does not go on");
    *event = false;
    *ended = instance->state.fault == ENDS;
    *early = instance->state.fault == RETURNS_EARLY;
    *until = time + step;
    return found;
}

int fmi3GetFMUState(Instance *instance, void **found) { return captured(instance, found); }

int fmi3SetFMUState(Instance *instance, void *state)
{
    instance->state = *(State *)state;
    return OK;
}

int fmi3FreeFMUState(Instance *instance, void **state)
{
    free(*state);
    *state = NULL;
    return OK;
}

int fmi3SerializedFMUStateSize(Instance *instance, void *state, size_t *size)
{
    *size = sizeof(State);
    return OK;
}

int fmi3SerializeFMUState(Instance *instance, void *state, uint8_t bytes[], size_t size)
{
    memcpy(bytes, state, size);
    return OK;
}

int fmi3DeserializeFMUState(Instance *instance, const uint8_t bytes[], size_t size, void **state)
{
    return read_state((const char *)bytes, size, state);
}

#define NOT_CALLED(name) int name(void) { return ERROR; }
NOT_CALLED(fmi3ActivateModelPartition)
NOT_CALLED(fmi3CompletedIntegratorStep)
NOT_CALLED(fmi3EnterConfigurationMode)
NOT_CALLED(fmi3EnterContinuousTimeMode)
NOT_CALLED(fmi3EnterEventMode)
NOT_CALLED(fmi3EnterStepMode)
NOT_CALLED(fmi3EvaluateDiscreteStates)
NOT_CALLED(fmi3ExitConfigurationMode)
NOT_CALLED(fmi3GetAdjointDerivative)
NOT_CALLED(fmi3GetBinary)
NOT_CALLED(fmi3GetClock)
NOT_CALLED(fmi3GetContinuousStateDerivatives)
NOT_CALLED(fmi3GetContinuousStates)
NOT_CALLED(fmi3GetDirectionalDerivative)
NOT_CALLED(fmi3GetEventIndicators)
NOT_CALLED(fmi3GetInt16)
NOT_CALLED(fmi3GetInt32)
NOT_CALLED(fmi3GetInt64)
NOT_CALLED(fmi3GetInt8)
NOT_CALLED(fmi3GetIntervalDecimal)
NOT_CALLED(fmi3GetIntervalFraction)
NOT_CALLED(fmi3GetNominalsOfContinuousStates)
NOT_CALLED(fmi3GetNumberOfContinuousStates)
NOT_CALLED(fmi3GetNumberOfEventIndicators)
NOT_CALLED(fmi3GetNumberOfVariableDependencies)
NOT_CALLED(fmi3GetOutputDerivatives)
NOT_CALLED(fmi3GetShiftDecimal)
NOT_CALLED(fmi3GetShiftFraction)
NOT_CALLED(fmi3GetString)
NOT_CALLED(fmi3GetUInt16)
NOT_CALLED(fmi3GetUInt32)
NOT_CALLED(fmi3GetUInt8)
NOT_CALLED(fmi3GetVariableDependencies)
NOT_CALLED(fmi3InstantiateModelExchange)
NOT_CALLED(fmi3InstantiateScheduledExecution)
NOT_CALLED(fmi3Reset)
NOT_CALLED(fmi3SetBinary)
NOT_CALLED(fmi3SetClock)
NOT_CALLED(fmi3SetContinuousStates)
NOT_CALLED(fmi3SetDebugLogging)
NOT_CALLED(fmi3SetFloat32)
NOT_CALLED(fmi3SetInt16)
NOT_CALLED(fmi3SetInt32)
NOT_CALLED(fmi3SetInt64)
NOT_CALLED(fmi3SetInt8)
NOT_CALLED(fmi3SetIntervalDecimal)
NOT_CALLED(fmi3SetIntervalFraction)
NOT_CALLED(fmi3SetShiftDecimal)
NOT_CALLED(fmi3SetShiftFraction)
NOT_CALLED(fmi3SetTime)
NOT_CALLED(fmi3SetUInt16)
NOT_CALLED(fmi3SetUInt32)
NOT_CALLED(fmi3SetUInt64)
NOT_CALLED(fmi3Terminate)
NOT_CALLED(fmi3UpdateDiscreteStates)
